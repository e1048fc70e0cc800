"""Measures the layout of the source: sizes, imports, options, and the path that one action takes.

    python scripts/house.py

The acting path is what runs in `select_action` on an episode's first observation: the modules of ours whose
functions are called, and how deep their calls nest. It is traced on a policy that is mined from two
demonstrations of one task, recorded for it (about a minute). The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
SRC, PACKAGE = ROOT / "src", "lerobot_openspm"
TASK = "bowl_on_plate"
# What every LeRobot command imports anyway.
LEROBOT = "import lerobot.policies, lerobot.configs, lerobot.envs.configs, torch"


def main() -> dict[str, Any]:
    """Print the measures, and return those of the last line."""
    files = sorted(SRC.rglob("*.py"))
    lines = {path: len(path.read_text().splitlines()) for path in files}
    functions = {f"{path.relative_to(SRC)}:{name}": n for path in files for name, n in function_lines(path)}
    modules, depth = acting_path()
    longest_file, longest_function = max(lines.values()), max(functions.values())
    print(f"median file: {statistics.median(lines.values()):.0f} lines")
    print(f"files over 350 lines: {sorted(str(p.relative_to(SRC)) for p, n in lines.items() if n > 350)}")
    print(f"functions over 50 lines: {sorted(name for name, n in functions.items() if n > 50)}")
    benchmarks = sum(len(path.read_text().splitlines()) for path in (ROOT / "benchmarks").rglob("*.py"))
    print(f"benchmarks: {benchmarks} lines")
    print(f"the plugin's import, beyond LeRobot's: {import_seconds():.2f} s")
    print(f"modules of the acting path: {', '.join(sorted(modules))}")
    measured = {
        "source_lines": sum(lines.values()),
        "files": len(files),
        "act_modules": len(modules),
        "act_depth": depth,
        "cycles": len(cycles(files)),
        "options": len(own_options()),
        "longest_file": longest_file,
        "longest_function": longest_function,
    }
    print(json.dumps(measured))
    return measured


def function_lines(path: Path) -> Iterator[tuple[str, int]]:
    """Name and length of every function of a file, decorators left out."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            yield node.name, node.end_lineno - node.lineno + 1


def cycles(files: list[Path]) -> list[set[str]]:
    """Rooms that import each other, and modules that do, directly or around."""
    modules = {
        ".".join(path.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__") for path in files
    }
    graph = {name: set[str]() for name in modules}
    for path in files:
        name = ".".join(path.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__")
        graph[name] = {found for found in imported(path) if found in modules} - {name}
    rooms: dict[str, set[str]] = {}
    for name, found in graph.items():
        rooms.setdefault(room(name), set()).update(room(one) for one in found if room(one) != room(name))
    return [*knots(rooms), *knots(graph)]


def room(module: str) -> str:
    """The folder that a module lies in; modules directly in the package are rooms of their own."""
    return ".".join(module.split(".")[:2])


def imported(path: Path) -> set[str]:
    """Dotted names that a file imports anywhere, but for its types alone."""
    found = set[str]()
    for node in runtime_nodes(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def runtime_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below one, without those for type checkers."""
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
            yield child
            yield from runtime_nodes(child)


def knots(graph: dict[str, set[str]]) -> list[set[str]]:
    """Groups of nodes that reach each other."""
    reach = {name: reachable(graph, name) for name in graph}
    groups = {frozenset({name, *(o for o in reach[name] if name in reach[o])}) for name in graph}
    return [set(group) for group in groups if len(group) > 1]


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    """All nodes that can be reached from one."""
    found, left = set[str](), [start]
    while left:
        new = graph.get(left.pop(), set()) - found
        found |= new
        left += new
    return found


def own_options() -> list[str]:
    """Every option of ``--policy.*`` that LeRobot's base configuration lacks; nested ones count."""
    from lerobot.configs import PreTrainedConfig

    from lerobot_openspm.configuration_openspm import OpenSPMConfig

    base = {field.name for field in dataclasses.fields(PreTrainedConfig)}
    return [name for name in leaves(OpenSPMConfig()) if name.split(".")[0] not in base]


def leaves(config: Any, prefix: str = "") -> Iterator[str]:
    """Dotted names of a configuration's options."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}"


def mined_policy() -> Any:
    """A policy that is mined from two demonstrations of one task, recorded for it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
    from lerobot.policies.factory import make_policy

    from lerobot_openspm.cli.pipeline import collect_dataset
    from lerobot_openspm.configuration_openspm import OpenSPMConfig

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        collect_dataset(root, 2, "openspm_tabletop", TASK)
        cameras = str(root / "meta" / "openspm_cameras.json")
        config = OpenSPMConfig(cameras=cameras, device="cpu", push_to_hub=False)
        return make_policy(config, ds_meta=LeRobotDatasetMetadata("local/house", root=root))


def first_observation(policy: Any) -> dict[str, Any]:
    """What the policy is shown first in an episode on the tabletop, by LeRobot's names."""
    import torch

    from lerobot_openspm.envs.tabletop.env import TabletopEnv

    env = TabletopEnv(task=TASK)
    env.reset(seed=2_350_000)
    batch: dict[str, Any] = {"task": [env.task_description]}
    batch["observation.state"] = torch.from_numpy(env.state())[None].float()
    for key in policy.config.image_features:
        image = env.simulator.render(key.rsplit(".", 1)[1], 256, 256)
        batch[key] = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255
    env.close()
    return batch


def acting_path() -> tuple[set[str], int]:
    """Modules of ours that run in the first `select_action` of an episode, and how deep their calls nest."""
    policy = mined_policy()
    batch = first_observation(policy)
    modules, deepest, now = set[str](), 0, 0

    def note(frame: FrameType, event: str, _: Any) -> None:
        nonlocal deepest, now
        name = frame.f_globals.get("__name__", "")
        if not name.startswith(PACKAGE) or event not in ("call", "return"):
            return
        modules.add(name)
        now += 1 if event == "call" else -1
        deepest = max(deepest, now)

    policy.reset()
    sys.setprofile(note)
    try:
        policy.select_action(batch)
    finally:
        sys.setprofile(None)
    return modules, deepest


def import_seconds(repeats: int = 5) -> float:
    """Seconds that importing the plugin adds to LeRobot's own imports, the median."""
    code = f"import time; {LEROBOT}; t = time.perf_counter(); import lerobot_policy_openspm; " + (
        "print(time.perf_counter() - t)"
    )
    runs = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        for _ in range(repeats)
    ]
    return statistics.median(float(run.stdout.split()[-1]) for run in runs)


if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    main()
