"""Light that a scene throws on an avatar: what was recorded is taken apart, and lit anew."""
