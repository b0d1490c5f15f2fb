"""The real arm (serial port and camera)."""
