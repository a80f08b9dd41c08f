"""Bodies of a ray tracer that stand for the objects of a scene."""

from __future__ import annotations

import pytest

from caviar_protocol.errors import PayloadError
from caviar_space.meshes import assign_bodies


def test_bodies_are_given_by_name_whatever_the_order_of_objects() -> None:
    objects = [("van", "v"), ("b", ""), ("a", "")]
    expected = {"a": ("", 0), "b": ("", 1), "van": ("v", 0)}
    assert (
        assign_bodies(objects, {"": 2, "v": 1}) == assign_bodies(objects[::-1], {"": 2, "v": 1}) == expected
    )


def test_what_lacks_is_named_with_the_key_that_says_how_many() -> None:
    objects = [("a", "objects/car.ply"), ("b", "objects/car.ply")]
    pool = {"": 3, "objects/car.ply": 1}
    with pytest.raises(PayloadError, match=r"^pool\.car.*'b'.*'objects/car\.ply'.*1"):
        assign_bodies(objects, pool, {"objects/car.ply": "pool.car"})
    with pytest.raises(PayloadError, match=r"^object 'b' .*raise the pool size"):
        assign_bodies(objects, pool)


def test_a_mesh_that_the_run_lacks_is_no_matter_of_the_pool() -> None:
    with pytest.raises(PayloadError, match=r"'objects/truck\.ply'.*c\.ply\)"):
        assign_bodies([("a", "objects/truck.ply")], {"": 3, "c.ply": 1})
