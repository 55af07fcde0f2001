"""World: what stands still behind the person, as splats of its own."""
