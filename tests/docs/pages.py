"""The command lines that README and the docs show, as they are written there."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
# The page of results is made, of commands that are tested where they come from.
PAGES = (
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    *(page for page in sorted((REPOSITORY / "docs").glob("*.md")) if page.stem != "results"),
)
# What is not ours to test; `echo N | python` answers LIBERO's question.
THIRD_PARTY = ("export", "vllm", "git", "mamba", "hf", "mv", "./patching/hydra", "PYTHON", "echo")
OURS = (
    "make",
    "openspm",
    "lerobot-train",
    "lerobot-eval",
    "lerobot-annotate",
    "python",
    ".venv/bin/python",
    "pip",
)
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
SPAN = re.compile(r"`([^`]+)`")
ASSIGNMENT = re.compile(r"(?:export )?([A-Z_]+)=(\S+)")


@dataclass(frozen=True)
class Line:
    """A command line.

    Attributes:
        page: Where it stands.
        typed: As it is written, with the variables that were set above it filled in.
        in_block: Whether it stands in a block of commands, and not within a sentence.
    """

    page: str
    typed: str
    in_block: bool

    @property
    def words(self) -> list[str]:
        """The program and its arguments."""
        return shlex.split(self.typed, comments=True)

    @property
    def is_mention(self) -> bool:
        """Whether a sentence only names a command, without any argument of its own."""
        is_bare = not any(word.startswith("-") or " " in word for word in self.words)
        return is_bare and not self.in_block and self.words[0] != "python"


def lines() -> list[Line]:
    """Every command line, once."""
    found = []
    for page in PAGES:
        text, name = page.read_text(), page.relative_to(REPOSITORY).as_posix()
        for language, block in BLOCK.findall(text):
            if language in ("bash", "sh"):
                found += [Line(name, typed, True) for typed in _typed(block)]
        spans = (" ".join(span.split()) for span in SPAN.findall(BLOCK.sub("", text)))
        # What is cut short is no command.
        found += [Line(name, s, False) for s in spans if s.split()[0] in OURS and "..." not in s]
    return list({(line.page, line.typed): line for line in found}.values())


def _typed(block: str) -> list[str]:
    """The lines of a block: continued ones joined, variables filled in."""
    variables: dict[str, str] = {}
    found = []
    for line in block.replace("\\\n", " ").splitlines():
        if assigned := ASSIGNMENT.fullmatch(line.partition("#")[0].strip()):
            variables[assigned[1]] = assigned[2]
        elif line.strip():
            found.append(re.sub(r"\$([A-Z_]+)", lambda one: variables.get(one[1], one[0]), line))
    return found
