"""Every LeRobot command imports the plugin at its start, so it brings nothing but its configurations."""

import json
import subprocess
import sys
from typing import Any

import pytest

PROBE = """
import json, sys, time
import lerobot.policies, lerobot.configs, lerobot.envs.configs, torch  # what LeRobot's commands import anyway

before, start_s = set(sys.modules), time.process_time()
import lerobot_policy_openspm
spent_s = time.process_time() - start_s
print(json.dumps({"added": sorted(set(sys.modules) - before), "spent_s": spent_s}))
"""
OURS = ("lerobot_openspm", "lerobot_policy_openspm")
# What the two configurations are made of. The method itself is imported when a policy is made.
CONFIGURATIONS = ("configuration_openspm", "errors", "types", "geometry", "envs")


@pytest.fixture(scope="module")
def imported() -> dict[str, Any]:
    """What importing the plugin adds to LeRobot's own imports, and how long it takes."""
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_the_plugin_brings_no_library_that_lerobot_did_not_import(imported: dict[str, Any]):
    """No mujoco, and no part of SciPy, OpenCV or torchvision that LeRobot does not use itself."""
    own = sys.stdlib_module_names | set(OURS)
    assert [name for name in imported["added"] if name.split(".")[0] not in own] == []


def test_of_ours_the_configurations_alone_are_imported(imported: dict[str, Any]):
    rooms = {name.split(".")[1] for name in imported["added"] if name.startswith("lerobot_openspm.")}
    assert rooms == set(CONFIGURATIONS)


def test_the_import_is_quick(imported: dict[str, Any]):
    # It takes 0.05 s of processor time, which a busy machine does not change much.
    assert imported["spent_s"] < 0.3
