"""Hostile files and hostile command lines, fed to the real command: nothing of theirs may run or be written elsewhere.

``files`` and ``words`` are tables of cases. ``play`` copies a small run to a folder for every case and starts ``child`` there,
which arms the audit hook of ``hook`` and becomes the command. A case is passed if the hook saw no forbidden event, no file
outside the results changed, and the command ended in time with one sentence and no traceback. The broken variants in
``controls`` show that payloads would have been seen. What needs no process (values, shapes) is tested where it is read.
"""
