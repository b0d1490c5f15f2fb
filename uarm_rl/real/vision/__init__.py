"""What the real arm sees. With the emulator's camera the only user of OpenCV.

Read ``projection.py`` first: from a pixel to the arm and back. ``camera.py`` takes pictures, ``detection.py`` finds the object
in them. ``camera_model.py`` is a lens, its mount and the file that keeps them; ``lens_fit.py`` and ``hand_eye_fit.py`` measure.
"""
