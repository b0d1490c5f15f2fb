"""The arm in a browser, with viser (the extra ``view``).

Read ``scene.py`` first: arm, object and target in a viser scene, posed by joint angles. ``replay.py`` makes a page of recorded
episodes that needs no server. ``watch.py`` is a page that shows an arm live, ``guard.py`` the server for it, which lets in
nobody but who started it.

Uses ``task`` and ``sim``; the only owner of viser.
"""
