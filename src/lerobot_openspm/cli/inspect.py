"""`openspm inspect`: what `openspm memory show` prints, under a name that is found first."""

from lerobot_openspm.cli.memory_show import show as main

__all__ = ["main"]
