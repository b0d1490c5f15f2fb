"""Trained policies for other programs.

Read ``onnx_model.py`` first: a policy as an ONNX model, and what its numbers mean. ``model_card.py`` says in prose what it is,
how it was trained and how it did.

Uses ``task``, and the intervals of ``report``; the only owner of onnx.
"""
