"""STGA: selective-training Gaussian head avatars. Importing it needs nothing but Python."""

__version__ = "0.2.0"
