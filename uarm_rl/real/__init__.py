"""The real arm. No byte goes to it that ``audit.py`` has not seen, and every way out ends with the arm stopped.

Read ``swift_arm.py`` first: the driver, behind the task's ``Arm`` protocol. Below it, from the wire upwards:

- ``ports.py``: which serial port is whose; ``link.py``: numbered requests with deadlines; ``gcode.py``: commands and replies
- ``handshake.py``: the first words; ``audit.py``: one pure function between a wish and the wire

On it: ``trials.py`` (find, reach, suck, lift, put down), ``search.py`` (find with the camera), ``session.py`` (connect,
record), ``live.py`` (tell who looks on), ``doctor.py`` (look at everything), ``collecting.py`` (what a calibration needs).
Cameras and geometry: ``vision/__init__.py``.

Uses ``task``. Needs neither torch nor PyBullet.
"""
