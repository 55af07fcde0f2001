"""Live face capture: datagrams of phones and programs as ARKit weights."""
