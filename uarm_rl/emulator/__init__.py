"""A stand-in for the arm: the firmware's serial protocol in front, joints behind, on a pseudo-terminal."""
