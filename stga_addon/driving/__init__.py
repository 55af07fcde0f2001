"""Driving a head by ARKit's 52 blend shapes: recordings, the map to a FLAME head, and back."""
