"""Language-driven driving, hierarchical, in TorchRL."""

__version__ = "0.1.0"
