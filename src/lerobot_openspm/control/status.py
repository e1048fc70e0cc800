"""What an episode is up to, and what can follow what."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """State of one episode. Only the world causes these; bad input raises."""

    WAITING = "waiting"  # no plan yet, for the instruction or for its next subtask
    RUNNING = "running"
    PAUSED = "paused"  # holds still until an object or a camera's picture is back
    DONE = "done"  # every key pose was reached; the hand holds still
    OBJECT_NOT_FOUND = "object_not_found"
    INFEASIBLE = "infeasible"  # no entry passes the transfer checks here
    NO_PROGRESS = "no_progress"  # attempts are used up
    OBJECT_LOST = "object_lost"  # what is needed now was seen before and is gone; looked for until it is back
    NOT_UNDERSTOOD = "not_understood"  # nothing in the memory is about the instruction
    CAMERA_FAULT = "camera_fault"  # a camera gave no sound picture for too long


_PLANNING = {Status.RUNNING, Status.OBJECT_NOT_FOUND, Status.INFEASIBLE}
_GIVING_UP = {Status.NOT_UNDERSTOOD, Status.CAMERA_FAULT}

# What can follow each state. The last three end the episode.
TRANSITIONS: dict[Status, frozenset[Status]] = {
    Status.WAITING: frozenset(_PLANNING | _GIVING_UP),
    Status.OBJECT_NOT_FOUND: frozenset(_PLANNING | _GIVING_UP),
    Status.INFEASIBLE: frozenset(_PLANNING | _GIVING_UP),
    Status.RUNNING: frozenset(
        {Status.PAUSED, Status.OBJECT_LOST, Status.DONE, Status.NO_PROGRESS} | _GIVING_UP
    ),
    Status.PAUSED: frozenset({Status.RUNNING, Status.OBJECT_LOST, Status.NO_PROGRESS} | _GIVING_UP),
    Status.OBJECT_LOST: frozenset({Status.RUNNING, Status.NO_PROGRESS} | _GIVING_UP),
    # From the end it goes on with the next subtask, or back to one whose outcome is not met.
    Status.DONE: frozenset({Status.WAITING, Status.RUNNING, Status.NO_PROGRESS, Status.NOT_UNDERSTOOD}),
    Status.NO_PROGRESS: frozenset(),
    Status.NOT_UNDERSTOOD: frozenset(),
    Status.CAMERA_FAULT: frozenset(),
}
