"""A stand-in for arm and camera: the firmware's serial protocol in front, joints and a world behind.

Read ``firmware.py`` first: bytes and time in, bytes out. ``firmware_3_2.py`` is the older dialect. Behind it:

- ``controller.py``: what the commands do; ``motion.py``: the planner; ``geometry.py``: the firmware's own arithmetic
- ``physics.py``: arm, table, box and suction in PyBullet; ``camera.py``: the camera; ``optics.py``, ``view.py``: what it sees
- ``realism.py``: how far from perfect it all is; ``faults.py``: what may go wrong

In front: ``pty.py`` (pseudo-terminals), ``memory_port.py`` (a port in memory, with its own clock), ``emulate.py`` (all of it).

Uses ``task``, ``sim`` and ``real``: the protocol's constants, never the driver.
"""
