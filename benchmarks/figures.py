"""All figures of the tabletop, each as a JSON file under ``benchmarks/results``, and a summary of them."""

import json
import logging

from benchmarks import conditioning, execution, oracle, perception, selection, tables


def main() -> None:
    """Measure what is not measured yet, and print the summary as one JSON object."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    followed, errors = execution.main(), perception.main()
    truth, _ = oracle.main(), conditioning.main()
    beside = {name: selection.main(name)["runs"][name] for name in selection.SEEDS}
    tables.write_page()
    runs = followed["runs"]
    summary = {
        "oracle_success": truth["oracle"]["success"],
        **{
            f"{name}_success": runs[name]["success"]
            for name in ("open_loop", "closed_loop", "closed_loop_trc")
        },
        "mean_steps": runs["closed_loop_trc"]["mean_steps"],
        "expert_steps": followed["expert_steps"],
        **{name: errors[name] for name in ("position_mm_mean", "position_mm_p95", "yaw_deg_mean")},
        "n": runs["closed_loop_trc"]["n"],
        **{f"{name}_success": run["success"] for name, run in beside.items()},
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
