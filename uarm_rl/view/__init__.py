"""The arm in a browser, with viser (the extra ``view``).

Read ``scene.py`` first: arm, object and target in a viser scene, posed by joint angles. ``replay.py`` makes a page of recorded
episodes that needs no server.

Uses ``task`` and ``sim``; the only owner of viser and yourdfpy.
"""
