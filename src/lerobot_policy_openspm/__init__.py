"""What LeRobot's plugin discovery imports: registers the policy and the tabletop environment, nothing else."""

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.configuration_tabletop import TabletopEnvConfig

__all__ = ["OpenSPMConfig", "TabletopEnvConfig"]
