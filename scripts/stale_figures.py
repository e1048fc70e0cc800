"""Lists the figures that README and the docs quote, and what has changed since they were measured.

    python scripts/stale_figures.py [--check]

A figure is stale when the code it measures has changed since; it is unreproducible when its result file, its
command or its commit is missing, or when it was measured on changes that were not committed. Which code a
figure measures is said in ``benchmarks/figures.py``. The last line is one JSON object; with ``--check`` the
exit code is 1 if any figure is stale or unreproducible.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))


def main(root: Path = ROOT) -> dict[str, int]:
    """Print the report and return its counts."""
    from benchmarks.figures import FIGURES
    from benchmarks.staleness import origin, quotes, read_result

    counts = {"quoted": 0, "stale": 0, "unreproducible": 0}
    found = quotes(root)
    for name in dict.fromkeys(quote.name for quote in found):
        figure, result = FIGURES.get(name), read_result(name, root) or {}
        known = origin(name, figure and figure.paths, root, figure and figure.command)
        print(f"benchmarks/results/{name}.json, commit {known.commit}: {known.problem or 'current'}")
        for change in known.changes:
            print(f"    {change}")
        for quote in (quote for quote in found if quote.name == name):
            missing = known.missing or (None if quote.key in result else f"the result has no {quote.key}")
            counts["quoted"] += 1
            counts["unreproducible"] += missing is not None
            counts["stale"] += missing is None and bool(known.changes)
            print(f"  {quote.page}:{quote.line} quotes {quote.key}{f': {missing}' if missing else ''}")
    print(json.dumps(counts))
    return counts


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="fail if a figure is stale or cannot be taken again"
    )
    check = parser.parse_args().check
    counted = main()
    sys.exit(int(check and counted["stale"] + counted["unreproducible"] > 0))
