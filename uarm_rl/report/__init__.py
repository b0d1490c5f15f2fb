"""Tables and figures, from the CSV files of the runs and nothing else.

Read ``report.py`` first: it assembles all of it. ``records.py`` reads and checks every cell and computes nothing;
``statistics.py`` computes; ``tables.py`` and ``figures.py`` write. A module for each further section:

- ``table1.py``: the paper's table
- ``paper_fit.py``: the same at the tolerance that makes one cell of it the paper's
- ``learning.py``: rewards, learning curves, an arm that shakes beside one that waits
- ``comparisons.py``: which differences between the methods the data can show
- ``robustness.py``: other tolerances, positions and holds
- ``leaning.py``: the same policies with nothing solid to lean on, and with a cup that gives
- ``engines.py``: the same policies in PyBullet and in MuJoCo
- ``sample_efficiency.py``: success against what it cost
- ``beyond.py``: past obstacles, and motors that are told torques
- ``ablations.py``: the shorter runs that say why it works
- ``arm_trials.py``: trials on an arm
- ``replays.py``: recorded tests in 3-D, on the page alone
- ``provenance.py``: engines, versions, hashes, on the page alone

``page.py`` makes ``report.html`` of all sections; ``svg.py`` fits a figure into it; its frame, style and script are in
``assets/``.

``inventory.py`` is no section: it lists the runs that a folder holds, for ``uarm-rl runs``.

Uses ``task``, and ``view`` where viser is installed; the only owner of pandas and Matplotlib.
"""
