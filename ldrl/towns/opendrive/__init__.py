"""OpenDRIVE road networks as highway-env networks."""

from ldrl.towns.opendrive.network import load_network

__all__ = ["load_network"]
