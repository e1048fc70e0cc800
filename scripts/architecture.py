"""Draws the flow of data between the rooms into docs/architecture.md, from what the code really calls.

    python scripts/architecture.py

A policy is mined from two demonstrations and asked for its first action (a minute). Calls from one room into
another are noted with the type that comes back. The picture is Mermaid text, which GitHub shows as a graph.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
import sys
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from house import PACKAGE, ROOT, SRC, first_observation, mined_policy, room

PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- picture: written by python scripts/architecture.py -->", "<!-- end of picture -->"
# Every room uses these; arrows to them would hide the others.
LEFT_OUT = {"geometry", "types", "errors", "files", "configuration_openspm", "envs", "cli"}
SHOWN_PER_ARROW = 3

# By caller and callee: the functions that are called and what they return, in the order of the first call.
Calls = dict[tuple[str, str], list[str]]


def main() -> None:
    """Trace, draw, and put the picture into the page."""
    learning, acting = Calls(), Calls()
    with noted(learning):
        policy = mined_policy()
    batch = first_observation(policy)
    policy.config.execution = "closed_loop"  # asks the flow model at once, the default not before a push
    policy.reset()
    with noted(acting):
        policy.select_action(batch)
    picture = "\n".join([BEGIN, "", *drawn(learning, acting), "", END])
    PAGE.write_text(re.sub(f"{BEGIN}.*?{END}", lambda _: picture, PAGE.read_text(), flags=re.S))


@contextmanager
def noted(calls: Calls) -> Generator[None]:
    """Note every call from one room into another while this is open."""

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or not (callee := module_of(frame)):
            return
        before = frame.f_back
        while before is not None and not module_of(before):
            before = before.f_back
        if before is None:
            return
        arrow = room_of(module_of(before)), room_of(callee)
        if arrow[0] == arrow[1] or set(arrow) & LEFT_OUT:
            return
        if (label := described(frame)) and label not in calls.setdefault(arrow, []):
            calls[arrow].append(label)

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


def module_of(frame: FrameType) -> str:
    """Name of the module of ours that a frame runs in; "" for any other."""
    name = frame.f_globals.get("__name__", "")
    return name if name.startswith(f"{PACKAGE}.") else ""


def room_of(module: str) -> str:
    """A room's name without the package's."""
    return room(module).removeprefix(f"{PACKAGE}.")


def described(frame: FrameType) -> str:
    """A public function and what it returns, "detect: Detections"; "" for any other."""
    names = frame.f_code.co_qualname.split(".")
    if frame.f_code.co_filename.startswith("<") or any(name.startswith(("_", "<")) for name in names):
        return ""
    found: Any = importlib.import_module(module_of(frame))
    for name in names:
        found = getattr(found, name, None)
    returned = getattr(found, "__annotations__", {}).get("return") or ""
    return f"{names[-1]}: {returned}" if returned and returned != "None" else ""


def own_types() -> set[str]:
    """Names of all classes of ours."""
    trees = [ast.parse(path.read_text()) for path in SRC.rglob("*.py")]
    return {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def drawn(learning: Calls, acting: Calls) -> list[str]:
    """One graph: the rooms, thin arrows for learning and thick ones for acting."""
    rooms = dict.fromkeys(name for calls in (learning, acting) for arrow in calls for name in arrow)
    types = re.compile(rf"\b({'|'.join(own_types())})\b")
    lines = ["```mermaid", "flowchart TD", *(f"  {name}" for name in rooms)]
    for calls, arrow in ((learning, "-.->"), (acting, "==>")):
        for (caller, callee), labels in calls.items():
            # What has a type of ours says most of what passes.
            telling = [label for label in labels if types.search(label.partition(":")[2])] or labels
            if telling:
                shown = "<br>".join(telling[:SHOWN_PER_ARROW])
                lines.append(f'  {caller} {arrow}|"{shown}"| {callee}')
    return [*lines, "```"]


if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    os.environ.setdefault("MUJOCO_GL", "egl")
    main()
