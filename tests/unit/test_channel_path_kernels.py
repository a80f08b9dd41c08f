"""Compiled loops of paths: trees against every triangle, and what is said while loops compile."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_services.channel.enumeration import compiled_loops

pytest.importorskip("numba")
from caviar_services.channel.enumeration import beam_kernels, path_kernels


def first_of_all(corners: Float64Array, start: Float64Array, end: Float64Array) -> tuple[float, int]:
    """Distance from the end to the first triangle on a segment, and its number, by looking at all of them."""
    length = float(np.linalg.norm(end - start))
    best, number = np.inf, -1
    for t, (a, b, c) in enumerate(corners):
        system = np.column_stack([(end - start) / length, a - b, a - c])
        if abs(np.linalg.det(system)) < 1e-14:
            continue
        along, u, v = np.linalg.solve(system, a - start)
        if u >= 0 and v >= 0 and u + v <= 1 and 0 < along < min(length, best):
            best, number = along, t
    return best - length, number


def trees_of(vertices: Float64Array, faces: Any, split: int) -> tuple[Any, Any]:
    """Two trees, of the triangles before ``split`` and of the others, fitted to the vertices."""
    one, two = (path_kernels.build(vertices[part].sum(1)) for part in (faces[:split], faces[split:]))
    nodes, order = np.concatenate([one[0], two[0]]), np.concatenate([one[1], two[1] + split])
    own = nodes[len(one[0]) :]
    own[own[:, 0] >= 0, 0] += len(one[0])
    own[:, 1:] += split
    standing = np.array([[0, len(one[0])], [len(one[0]), len(nodes)]])
    trees = nodes, order, np.zeros((len(nodes), 6)), np.zeros((len(faces), 9))
    path_kernels.fit(trees, standing, vertices, faces)
    return standing, trees


def test_a_tree_finds_the_first_triangle_of_all() -> None:
    """Also along axes, within flat boxes, and after the vertices of one tree have moved."""
    rng = np.random.default_rng(4)
    vertices = rng.uniform(-5, 5, (180, 3))
    vertices[:30, 2] = np.repeat(np.arange(10) - 4.5, 3)  # level triangles, in boxes without height
    faces = np.arange(180).reshape(60, 3)
    standing, trees = trees_of(vertices, faces, 40)
    start, end = rng.uniform(-6, 6, (2, 200, 3))
    end[:30, :2] = start[:30, :2]
    end[30:60, 1:] = start[30:60, 1:]
    for shift in (0.0, 1.5):
        vertices[120:] += shift
        path_kernels.fit(trees, standing[1:], vertices, faces)
        behind, met = path_kernels.first_met(start, end, standing, trees)
        wanted = [first_of_all(vertices[faces], *segment) for segment in zip(start, end, strict=True)]
        assert met.tolist() == [number for _, number in wanted]
        assert np.allclose(behind, [least for least, _ in wanted])
        assert 20 < (met >= 0).sum() < 180
    behind, met = path_kernels.first_met(start, end, standing[:1], trees)
    assert met.max() < 40


def test_each_loop_is_named_while_it_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = []

    class Loop:
        def compile(self, signature: str) -> None:
            said.append(signature)

        def disable_compile(self) -> None:
            said.append("closed")

    assert beam_kernels.WIDTH  # imported, so that its loops are none of these
    loops = [(Loop(), "f8(f8)", False), (Loop(), "b1(b1)", True), (Loop(), "i8(i8)", False)]
    monkeypatch.setattr(compiled_loops, "_loops", loops)
    for edges in (False, True, True):  # nothing is left for the last run of a process
        compiled_loops.compile_loops(lambda number, count: said.append((number, count)), edges)
    assert said[:6] == [(0, 2), "f8(f8)", "closed", (1, 2), "i8(i8)", "closed"]
    assert said[6:] == [(0, 1), "b1(b1)", "closed"]
