"""Language-driven driving, hierarchical, in TorchRL.

Importing it registers the Gymnasium environments ``ldrl/Town1-v0``, ``ldrl/Town2-v0`` and ``ldrl/Town-v0``.
"""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

register("ldrl/Town-v0", "ldrl.envs.highway:HighwayTownEnv")
register("ldrl/Town1-v0", "ldrl.envs.highway:HighwayTownEnv", kwargs={"town": "town1"})
register("ldrl/Town2-v0", "ldrl.envs.highway:HighwayTownEnv", kwargs={"town": "town2"})
