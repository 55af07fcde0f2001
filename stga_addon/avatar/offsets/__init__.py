"""Driven offsets: positions of splats that follow a signal of the pose."""
