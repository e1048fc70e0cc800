"""How Hypothesis draws examples for the tests of properties.

By default every run draws the same examples, so that a test that was green stays green until code changes.
``HYPOTHESIS_PROFILE=explore`` draws new ones each time, and more of them; a failure prints what repeats it.
"""

import os

from hypothesis import settings

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "default")
# So many times the examples of the default profile.
EXPLORED = {"default": 1, "explore": 5}
DEFAULT_EXAMPLES = 100

# A busy machine is no failure, hence no deadline.
settings.register_profile(
    "default", max_examples=DEFAULT_EXAMPLES, deadline=None, derandomize=True, database=None
)
settings.register_profile(
    "explore",
    max_examples=EXPLORED["explore"] * DEFAULT_EXAMPLES,
    deadline=None,
    derandomize=False,
    database=None,
    print_blob=True,
)
settings.load_profile(PROFILE)


def examples(count: int) -> settings:
    """Settings of a property whose examples are expensive: ``count`` of them, more when exploring."""
    return settings(max_examples=count * EXPLORED[PROFILE])
