"""The simulated arm (PyBullet)."""
