"""What LeRobot's plugin discovery imports: registers the policy and the tabletop, and nothing else."""

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.tabletop.configuration import TabletopEnvConfig

__all__ = ["OpenSPMConfig", "TabletopEnvConfig"]
