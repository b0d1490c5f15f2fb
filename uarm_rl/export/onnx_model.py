"""A policy as an ONNX model, node by node: the exporter of a framework would need the framework, and knows no units."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from typing import Any, Final

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from uarm_rl.task import kinematics, observation
from uarm_rl.task.policy import ActorPolicy

#: Old enough for the runtimes that are about (ONNX 1.12, 2022).
_OPSET: Final = 17
_IR_VERSION: Final = 8

#: The key of a model's metadata under which ``description`` stands, as JSON.
METADATA: Final = "uarm-rl"

#: What an action asks for, by what it is relative to.
_MEANINGS: Final = {
    "joint": "a joint's reference is its angle now plus max_delta_rad times its action, cut at the joint's limits",
    "reference": "a joint's reference is its last one plus max_delta_rad times its action, cut at the joint's limits",
    "absolute": "a joint's reference is the middle of its limits plus half their distance times its action",
    "torque": "a joint's torque is its action times torque_nm of the servo",
}


def description(policy: ActorPolicy) -> dict[str, Any]:
    """What goes into the model, what comes out, with names and units, and the policy's card: how it is to be run."""
    card = policy.card
    numbers = [{"name": name, "unit": _unit(name)} for name in observation.kind(card.observation).names]
    low, high = kinematics.JOINT_LIMITS_RAD.T.tolist()
    joints = [
        {"name": f"joint{number}", "low_rad": least, "high_rad": most}
        for number, (least, most) in enumerate(zip(low, high, strict=True), 1)
    ]
    duration = [{"name": "duration", "steps": [1, card.hold["max_control_steps"]]}] if card.outputs > len(joints) else []
    return {
        "input": {"name": "observation", "type": "float32", "shape": ["batch", card.inputs], "numbers": numbers},
        "output": {
            "name": "action",
            "type": "float32",
            "shape": ["batch", card.outputs],
            "range": [-1.0, 1.0],
            "meaning": _MEANINGS[card.actions],
            "numbers": [*joints, *duration],
        },
        "frame": "base of the arm: x ahead, y to the left, z up; metres and radians",
        "policy": asdict(policy.card),
    }


def _unit(name: str) -> str:
    name = re.sub(r"_\d+_ago$", "", name)  # an older frame of a stack
    units = {"_m": "m", "_rad": "rad", "_rad_s": "rad/s", "flag": "0 or 1"}
    return next((unit for end, unit in units.items() if name.endswith(end)), "1")


def onnx_model(policy: ActorPolicy, *, precision: str = "float64") -> bytes:
    """The model: ``observation``, shape (batch, 20), to ``action``, shape (batch, 3), both float32; scaling included. Other
    kinds of policy have other sizes, those of their card.

    It computes in float64, as the policy itself does, or in float32, for a runtime that has nothing else: sums of several
    hundred products then differ in the sixth decimal of an action. The weights are stored as the float32 numbers they are.
    """
    number_type = {"float32": TensorProto.FLOAT, "float64": TensorProto.DOUBLE}[precision]
    constants, nodes = [], []

    def node(operator: str, *inputs: str, output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    def exact(name: str) -> str:
        return name if precision == "float32" else node("Cast", name, output=f"{name}_{precision}", to=number_type)

    def constant(name: str, values: Any) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(values, np.float32), name))
        return exact(name)

    x = node("Sub", exact("observation"), constant("offset", policy.offset), output="centred")
    x = node("Div", x, constant("scale", policy.scale), output="scaled")
    for number, (weight, bias) in enumerate(policy.layers):
        if number:
            x = node("Relu", x, output=f"hidden{number}")
        weights = constant(f"weight{number}", weight), constant(f"bias{number}", bias)
        x = node("Gemm", x, *weights, output=f"sum{number}")
    node("Cast", node("Tanh", x, output="squashed"), output="action", to=TensorProto.FLOAT)
    graph = helper.make_graph(
        nodes,
        "uarm-rl policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", policy.card.inputs])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", policy.card.outputs])],
        constants,
    )
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=_IR_VERSION, producer_name="uarm-rl")
    helper.set_model_props(model, {METADATA: json.dumps(description(policy), sort_keys=True)})
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString(deterministic=True)
    return content
