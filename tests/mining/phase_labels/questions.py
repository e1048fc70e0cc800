"""Questions about a hand that picks something up and puts it down."""

import numpy as np

from lerobot_openspm.mining.phase_labels.base import Moment, PhaseQuestion
from lerobot_openspm.mining.phase_labels.question import contact_sheets

PHASES = ("approach", "approach", "grasp", "lift", "pre-place", "place", "release", "retreat")
CLOSING = (False, False, True, True, True, True, False, False)
CAMERAS = ("observation.images.front", "observation.images.side", "observation.images.wrist")


def moment(time_s: float, closing: bool, height: float = 0.1) -> Moment:
    return Moment(time_s, (0.1, -0.2, height), (3.1, 0.0, 0.0), 0.4 if closing else 1.0, closing)


def pick_and_place(
    cameras: int = 3, episode: int = 0, instruction: str = "put the bowl on the plate", n: int = len(PHASES)
) -> PhaseQuestion:
    """The first n candidates of eight, one a second, with pictures that mean nothing."""
    rng = np.random.default_rng(episode)
    pictures = {
        name: [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(n)]
        for name in CAMERAS[:cameras]
    }
    candidates = tuple(moment(i + 1.0, closing) for i, closing in enumerate(CLOSING[:n]))
    sheets = {name: contact_sheets(tiles) for name, tiles in pictures.items()}
    return PhaseQuestion("local/a", episode, instruction, candidates, candidates[::2], sheets, PHASES[:n])
