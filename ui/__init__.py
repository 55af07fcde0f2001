"""Panels, preferences and the properties of a scene."""
