"""STGA: selective-training Gaussian head avatars. Importing this package needs nothing but Python."""

__version__ = "0.1.0"
