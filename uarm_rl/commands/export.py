"""Write a trained policy for other programs: as ONNX, with a description of its numbers and a model card.

Examples:
  uarm-rl export run=results/adaptive-penalty/seed0 out=policy.onnx   policy.onnx, policy.json and policy.md
  uarm-rl export run=mine/adaptive-penalty/seed0 precision=float32 out=small.onnx   for a runtime without float64
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from uarm_rl import checks, files
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings
from uarm_rl.export import model_card, onnx_model
from uarm_rl.task.policy import ActorPolicy
from uarm_rl.trained import load_policy, read_run


def run(settings: Settings) -> None:
    """Write the model, its description and its card."""
    checks.one_of("format", settings["format"], ("onnx",))
    precision = checks.one_of("precision", settings["precision"], ("float64", "float32"))
    run_dir, out = checks.path("run", settings["run"]), output(settings)
    if out.suffix != ".onnx":
        raise UsageError(f"out must end in .onnx, got {out}")
    beside = {suffix: out.with_suffix(suffix) for suffix in (".onnx", ".json", ".md")}
    for path in beside.values():
        if path.exists() or path.is_symlink():
            raise UsageError(f"{path} exists already; remove it, or choose another file with out=FILE.onnx")
    files.check_place(out)
    run_settings = read_run(run_dir)
    policy = load_policy(run_dir, None, run_settings)
    assert isinstance(policy, ActorPolicy)
    model = onnx_model.onnx_model(policy, precision=precision)
    hashes = {
        "sha256": hashlib.sha256(model).hexdigest(),
        "policy_sha256": hashlib.sha256(files.read(run_dir / files.POLICY)).hexdigest(),
    }
    described = {"file": out.name, **hashes, "precision": precision, **onnx_model.description(policy)}
    card = model_card.model_card(policy.card, run_settings, run_dir, model_card.Export(out.name, **hashes))
    out.parent.mkdir(parents=True, exist_ok=True)
    contents = {".onnx": model, ".json": f"{json.dumps(described, indent=2)}\n".encode(), ".md": card.encode()}
    for suffix, content in contents.items():
        files.replace(beside[suffix], content)
        print(beside[suffix])


def output(settings: Settings) -> Path:
    """The model; what describes it lies beside."""
    return checks.path("out", settings["out"])
