"""What the real arm sees. With the emulator's camera the only user of OpenCV.

Read ``projection.py`` first: from a pixel to the arm and back. ``camera.py`` takes pictures, ``detection.py`` finds the object
in them, ``calibration.py`` fits lens and mount and keeps them in a file.
"""
