"""Small policies as ONNX files, made without a library that trains."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path

from msgspec.structs import replace
from onnx import TensorProto, helper

from caviar_protocol.observations import inputs_of
from caviar_protocol.scenario import Scenario
from caviar_services.agent.policy import ACTION, CARD_KEY, SCORES, PolicyCard, PolicyModel, write_card


def constant_policy(file: Path, pair: int, beams: tuple[int, int] = (64, 1)) -> Path:
    """A policy that chooses the same pair whatever it observes (``aod`` of one user)."""
    observed = helper.make_tensor_value_info("aod", TensorProto.FLOAT, [1, 1])
    chosen = helper.make_tensor_value_info(ACTION, TensorProto.INT64, [1, 1])
    nodes = [
        helper.make_node("Cast", ["aod"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Mul", ["whole", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "pair"], [ACTION]),
    ]
    numbers = [helper.make_tensor(n, TensorProto.INT64, [1], [v]) for n, v in (("zero", 0), ("pair", pair))]
    graph = helper.make_graph(nodes, "constant", [observed], [chosen], numbers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    card = PolicyCard(observe=("aod",), codebooks=(beams,), algorithm="constant", seeds=(1,))
    helper.set_model_props(model, {CARD_KEY: write_card(card)})
    file.write_bytes(model.SerializeToString())
    return file


def ranking_policy(
    file: Path, scores: Sequence[float], *, with_scores: bool = True, transmitter: str = "*"
) -> Path:
    """A policy that ranks pairs of beams in the same way whatever it observes (``aod`` of one user).

    Args:
        file: Is written.
        scores: Of each pair.
        with_scores: Whether the model gives them, and not its choice alone.
        transmitter: That it was trained for.
    """
    count = len(scores)
    outputs = [helper.make_tensor_value_info(ACTION, TensorProto.INT64, [1, 1])]
    if with_scores:
        outputs.append(helper.make_tensor_value_info(SCORES, TensorProto.FLOAT, [1, 1, count]))
    nodes = [
        helper.make_node("Mul", ["aod", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "constants"], [SCORES]),
        helper.make_node("ArgMax", [SCORES], [ACTION], axis=2, keepdims=0),
    ]
    numbers = [
        helper.make_tensor("zero", TensorProto.FLOAT, [1], [0.0]),
        helper.make_tensor("constants", TensorProto.FLOAT, [1, 1, count], list(scores)),
    ]
    observed = helper.make_tensor_value_info("aod", TensorProto.FLOAT, [1, 1])
    graph = helper.make_graph(nodes, "ranking", [observed], outputs, numbers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    card = PolicyCard(
        observe=("aod",),
        codebooks=((count, 1),),
        transmitters=(transmitter,),
        algorithm="constant",
        seeds=(1,),
    )
    helper.set_model_props(model, {CARD_KEY: write_card(card)})
    file.write_bytes(model.SerializeToString())
    return file


def perceptron_policy(file: Path, hidden: int = 64, beams: int = 64) -> Path:
    """A policy of two hidden layers with weights drawn from a seed, as benchmarks serve it."""
    import numpy as np
    from onnx import numpy_helper

    draws = np.random.default_rng(1)
    parts = {"aod": 1, "position": 3, "last_beam": 1, "last_rate": 1}
    sizes = [sum(parts.values()), hidden, hidden, beams]
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, w]) for n, w in parts.items()]
    chosen = helper.make_tensor_value_info(ACTION, TensorProto.INT64, [1])
    weights, nodes = [], [helper.make_node("Concat", list(parts), ["x0"], axis=1)]
    for layer, (before, after) in enumerate(pairwise(sizes)):
        for name, shape in ((f"w{layer}", (before, after)), (f"b{layer}", (after,))):
            weights.append(numpy_helper.from_array(draws.normal(size=shape).astype(np.float32), name))
        last = layer == len(sizes) - 2
        nodes.append(helper.make_node("Gemm", [f"x{layer}", f"w{layer}", f"b{layer}"], [f"y{layer}"]))
        if not last:
            nodes.append(helper.make_node("Relu", [f"y{layer}"], [f"x{layer + 1}"]))
    nodes.append(helper.make_node("ArgMax", [f"y{len(sizes) - 2}"], [ACTION], axis=1, keepdims=0))
    graph = helper.make_graph(nodes, "perceptron", inputs, [chosen], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    card = PolicyCard(observe=tuple(parts), codebooks=((beams, 1),), algorithm="random", seeds=(1,))
    helper.set_model_props(model, {CARD_KEY: write_card(card)})
    file.write_bytes(model.SerializeToString())
    return file


def scenario_with(folder: Path, file: str, frames: int, more: str = "") -> Path:
    """Scenario ``geometric`` with the agent ``policy``, in a folder."""
    root = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "geometric.toml"
    text = root.read_text().replace("frames = 500", f"frames = {frames}", 1)
    text = text.replace('use = "los-beam"', f'use = "policy"\nsettings.file = "file:{file}"', 1)
    path = folder / "scenario.toml"
    path.write_text(text + more)
    return path


def for_policy(scenario: Scenario, model: PolicyModel) -> Scenario:
    """A scenario with the transmitters that a policy was trained for, and only the sensors that it
    observes."""
    card = model.card
    assert card is not None
    topics = {entry.topic for entry in inputs_of(card.observe)}
    services = {
        name: spec for name, spec in scenario.services.items() if spec.role != "sensors" or spec.use in topics
    }
    devices = tuple(
        device
        for device in scenario.devices
        if device.kind in topics
        or (
            device.kind == "antenna"
            and (device.role != "tx" or any(fnmatchcase(device.name, t) for t in card.transmitters))
        )
    )
    return replace(scenario, services=services, devices=devices)
