"""What the real arm sees: cameras, detection, calibration and projection. The only user of OpenCV."""
