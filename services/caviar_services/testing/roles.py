"""Conformance tests of each role, beyond `ServiceConformance`.

Each class is subclassed in a test file of its own (`caviar_services.testing`). Clauses are those of the
service contract in `protocol/SPEC.md`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.coordinates import Pose
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import (
    PAYLOADS,
    Action,
    BeamChoice,
    CameraDevice,
    Channel,
    Depth,
    Lidar,
    Link,
    Scene,
    Segmentation,
)
from caviar_services.service import FrameInput, Service
from caviar_services.testing import samples
from caviar_services.testing.base import FRAMES, Played, ServiceConformance

P = TypeVar("P", bound=Payload)

# Field with the pixels of each kind of image.
_PIXELS = {"camera": "rgb", "depth": "depth", "segmentation": "object"}


def _products(played: Played, topic: str, cls: type[P]) -> Iterator[P]:
    """Products of a topic in the first episode, as they come off the wire."""
    for result in played.episodes[0]:
        if topic in result.products:
            assert isinstance(result.products[topic], cls)
            yield cast(P, result.products[topic])


def _array_sizes(scene: Scene) -> dict[str, int]:
    """Beams of each antenna, by name."""
    return {
        device.name: beam_count(device.array) for role in ("tx", "rx") for device in antennas(scene, role)
    }


def _sorted(names: Iterable[str]) -> bool:
    listed = list(names)
    return listed == sorted(set(listed))


class WorldConformance(ServiceConformance):
    """Worlds: objects and devices, one `Scene` a frame.

    Example:
        >>> from caviar_services.world.trajectory import TrajectoryWorld
        >>> class TestTrajectoryWorld(WorldConformance):
        ...     service_class = TrajectoryWorld
        >>> TestTrajectoryWorld.__test__
        True
    """

    @classmethod
    def street(cls, service: Service[Any], directory: Path) -> Mapping[str, Path]:
        """The scenery that the world itself brings, written to disk."""
        found = {}
        for name, content in service.scenery().items():
            found[name] = directory / name
            found[name].parent.mkdir(parents=True, exist_ok=True)
            found[name].write_bytes(content if isinstance(content, bytes) else content.read_bytes())
        return found

    def test_names_are_sorted_and_begin_with_a_declared_prefix(self, played: Played) -> None:
        """Clause 3: a clash of two worlds is found before the first frame."""
        # Devices on objects begin with the name of their object, so theirs need no look of their own.
        for scene in _products(played, "scene", Scene):
            fixed = [device.name for device in scene.devices if not device.parent]
            assert _sorted(scene.names)
            assert _sorted(device.name for device in scene.devices)
            for name in (*scene.names, *fixed):
                assert name.startswith(played.prepared.prefixes), name

    def test_poses_are_physical(self, played: Played) -> None:
        """Unit quaternions with a fixed sign, and boxes with a volume."""
        for scene in _products(played, "scene", Scene):
            np.testing.assert_allclose(np.linalg.norm(scene.orientation, axis=1), 1.0, atol=1e-9)
            assert (scene.dimensions > 0).all()

    def test_meshes_and_parents_exist(self, played: Played) -> None:
        """A consumer finds every mesh among the assets and every parent in the scene."""
        for scene in _products(played, "scene", Scene):
            assert set(scene.assets) <= {"", *played.assets}
            assert {device.parent for device in scene.devices} <= {"", *scene.names}

    def test_velocities_are_what_positions_do(self, played: Played) -> None:
        """Mean of the velocities at both ends of a step, against the way gone in it."""
        # Exact for a constant acceleration; the tolerance is for accelerations that change within a frame.
        scenes = list(_products(played, "scene", Scene))
        step = samples.SAMPLING_PERIOD_NS / 1e9
        for before, after in pairwise(scenes):
            for name in set(before.names) & set(after.names):
                i, j = before.names.index(name), after.names.index(name)
                gone = (after.position[j] - before.position[i]) / step
                mean = (before.velocity[i] + after.velocity[j]) / 2
                assert np.linalg.norm(gone - mean) <= 0.5 + 0.2 * np.linalg.norm(mean), name

    def test_skipped_frames_change_nothing(self, played: Played, tmp_path: Path) -> None:
        """Clause 6: a world steps the whole gap."""
        # Bit by bit: a world that steps in other pieces, or adds up time, comes out elsewhere.
        sparse = self.play(tmp_path, skip=range(1, FRAMES - 1))
        assert sparse.encoded() == [played.encoded()[0], played.encoded()[-1]]


class ChannelConformance(ServiceConformance):
    """Channel models: paths, and matrices, of all TX/RX pairs.

    Example:
        >>> from caviar_services.channel.statistical.free_space import FreeSpaceChannel
        >>> class TestFreeSpaceChannel(ChannelConformance):
        ...     service_class = FreeSpaceChannel
        >>> TestFreeSpaceChannel.__test__
        True
    """

    def test_pairs_are_those_of_the_scene(self, played: Played) -> None:
        """All transmitters and receivers, by name, also those without a path."""
        for frame, channel in zip(played.frames, _products(played, "channel", Channel), strict=True):
            scene = frame.scene()
            assert channel.tx == tuple(device.name for device in antennas(scene, "tx"))
            assert channel.rx == tuple(device.name for device in antennas(scene, "rx"))
            assert [c.name for c in channel.carriers] == [c.name for c in self.carriers]

    def test_paths_are_indexed_and_physical(self, played: Played) -> None:
        """Offsets cover all paths; no wave is faster than light; no path amplifies."""
        for channel in _products(played, "channel", Channel):
            count = len(channel.tau)
            assert channel.offsets[0] == 0
            assert channel.offsets[-1] == count
            assert (np.diff(channel.offsets) >= 0).all()
            assert len(channel.offsets) == len(channel.tx) * len(channel.rx) + 1
            assert (channel.tau > 0).all()
            # Passive: no path delivers more power than was sent.
            assert (np.abs(channel.a) < 1).all()
            for angle in (channel.aod, channel.aoa):
                assert ((angle[:, 0] >= 0) & (angle[:, 0] <= math.pi)).all()
                assert (np.abs(angle[:, 1]) <= math.pi + 1e-12).all()
            assert (channel.objects < len(channel.object_names)).all()
            assert ((channel.objects >= 0) | (channel.interactions == 0)).all()

    def test_some_path_is_found_in_the_street(self, played: Played) -> None:
        """Base station and both vehicles see each other there."""
        channels = list(_products(played, "channel", Channel))
        assert all(len(channel.tau) > 0 for channel in channels)
        assert all(channel.los.any() for channel in channels)

    def test_matrices_have_an_entry_per_antenna_pair(self, played: Played) -> None:
        """One matrix per carrier and pair, carriers slowest, [Nr, Nt]."""
        for frame, channel in zip(played.frames, _products(played, "channel", Channel), strict=True):
            size = _array_sizes(frame.scene())
            order = [(m.carrier, m.tx, m.rx) for m in channel.h]
            counts = (len(channel.carriers), len(channel.tx), len(channel.rx))
            assert order == [tuple(index) for index in np.ndindex(*counts)]
            for m in channel.h:
                assert m.h.shape == (size[channel.rx[m.rx]], size[channel.tx[m.tx]])

    def test_matrices_are_made_only_where_asked_for(self, tmp_path: Path) -> None:
        """Clause 5."""
        with self.at_start(tmp_path, {"channel": frozenset({"paths"})}) as service:
            (product,) = service.step(self.frames_of(service, 0)[0]).products.values()
        assert isinstance(product, Channel)
        assert product.h == product.hf == product.taps == ()

    def test_wideband_parts_agree_with_the_matrices(self, played: Played) -> None:
        """An entry per pair and carrier that has them; at the carrier and the frame's instant they are H."""
        for channel in _products(played, "channel", Channel):
            matrices = {(m.carrier, m.tx, m.rx): m.h for m in channel.h}
            for response in channel.hf:
                carrier = channel.carriers[response.carrier]
                assert response.h.shape[:2] == (carrier.slots, carrier.subcarriers)
                h = matrices[response.carrier, response.tx, response.rx]
                centre = response.h[0, carrier.subcarriers // 2]
                # Not equal bits: H is complex128, the response complex64.
                assert np.abs(centre - h).max() <= 1e-5 * np.abs(h).max(initial=0.0)
            for taps in channel.taps:
                carrier = channel.carriers[taps.carrier]
                assert taps.h.shape[:2] == (carrier.slots, carrier.taps)
            pairs = len(channel.tx) * len(channel.rx)
            assert len(channel.hf) == pairs * sum(c.subcarriers > 0 for c in channel.carriers)
            assert len(channel.taps) == pairs * sum(c.taps > 0 for c in channel.carriers)


class SensorConformance(ServiceConformance):
    """Sensors: what devices on moving objects see.

    Example:
        >>> from caviar_services.sensors.lidar import LidarSensors
        >>> class TestLidarSensors(SensorConformance):
        ...     service_class = LidarSensors
        >>> TestLidarSensors.__test__
        True
    """

    def test_scans_are_sorted_and_indexed(self, played: Played) -> None:
        """One scan per LIDAR with its points, whatever parts are asked for beside them."""
        for frame, lidar in zip(played.frames, _products(played, "lidar", Lidar), strict=False):
            names = [device.name for device in frame.scene().devices]
            assert _sorted(scan.sensor for scan in lidar.scans)
            for scan in lidar.scans:
                assert scan.sensor in names
                assert len(scan.points) > 0, "the street has ground and wall in reach"
                assert (np.diff(scan.ray) > 0).all()
                assert ((scan.object >= 0) & (scan.object < len(lidar.object_names))).all()
                np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1), scan.range, rtol=1e-5)

    def test_images_are_those_of_the_scenes_cameras(self, played: Played) -> None:
        """Size, pose and optics; sorted by name, one of each camera on each topic."""
        for topic in {"camera", "depth", "segmentation"} & set(self.service_class.outputs):
            products = _products(played, topic, PAYLOADS[topic])
            for frame, product in zip(played.frames, products, strict=True):
                scene = frame.scene()
                devices = [device for device in scene.devices if isinstance(device, CameraDevice)]
                images = product.images  # type: ignore[attr-defined]  # all three have them
                for device, image in zip(devices, images, strict=True):
                    assert image.sensor == device.name
                    assert Pose(image.position, image.orientation) == device_pose(scene, device)
                    assert (image.intrinsics.cx, image.intrinsics.cy) == (device.width / 2, device.height / 2)
                    assert getattr(image, _PIXELS[topic]).shape[:2] == (device.height, device.width)

    def test_depth_and_segmentation_agree_on_what_is_there(self, played: Played) -> None:
        """Pixels that have a depth have a name, a material and a normal of length 1."""
        if not {"depth", "segmentation"} <= set(self.service_class.outputs):
            pytest.skip("sees no images")
        products = zip(
            _products(played, "depth", Depth), _products(played, "segmentation", Segmentation), strict=True
        )
        for depth, segmentation in products:
            for near, named in zip(depth.images, segmentation.images, strict=True):
                assert near.normals is not None
                assert named.material is not None
                found = near.depth > 0
                assert found.any(), "the street has ground and wall in sight"
                np.testing.assert_array_equal(named.object >= 0, found)
                np.testing.assert_array_equal(named.material >= 0, found)
                assert named.object.max() < len(segmentation.object_names)
                assert named.material.max() < len(segmentation.material_names)
                length = np.linalg.norm(near.normals, axis=2)
                np.testing.assert_allclose(length, np.where(found, 1.0, 0.0), atol=1e-5)

    def test_only_topics_and_parts_in_demand_are_computed(self, tmp_path: Path) -> None:
        """Clause 5: one topic asked for, without its parts."""
        for topic in self.service_class.outputs:
            with self.at_start(tmp_path / topic, {topic: frozenset()}) as service:
                products = service.step(self.frames_of(service, 0)[0]).products
            assert set(products) == {topic}
            for image in getattr(products[topic], "images", ()):
                assert getattr(image, "normals", None) is None
                assert getattr(image, "material", None) is None

    def test_what_no_service_asks_for_is_not_computed(self, tmp_path: Path) -> None:
        """Clause 5."""
        with self.at_start(tmp_path, {}) as service:
            assert service.step(self.frames_of(service, 0)[0]).products == {}


class LinkConformance(ServiceConformance):
    """Links: what users got out of the chosen beams.

    Example:
        >>> from caviar_services.link.beams import BeamLink
        >>> class TestBeamLink(LinkConformance):
        ...     service_class = BeamLink
        ...     settings = {"top_k": 3}
        >>> TestBeamLink.__test__
        True
    """

    def test_users_are_listed_once_in_order(self, played: Played) -> None:
        """Sorted by carrier, TX, RX."""
        for link in _products(played, "link", Link):
            users = list(zip(link.carrier, link.tx, link.rx, strict=True))
            assert users == sorted(set(users))
            assert len(users) > 0

    def test_no_pair_is_better_than_the_best(self, played: Played) -> None:
        """Chosen and baseline pairs are bounded by eq. 2, and the list of the best falls."""
        for link in _products(played, "link", Link):
            assert (np.diff(link.top_abs_y, axis=1) <= 0).all()
            # A link may compute a chosen pair another way than all of them; last bits differ then.
            best = link.top_abs_y[:, 0] * (1 + 1e-12)
            assert (link.abs_y <= best).all()
            assert (link.baseline_abs_y <= best).all()
            assert (link.snr <= link.snr_best * (1 + 1e-12)).all()

    def test_users_without_a_path_are_counted_and_get_nothing(self, played: Played) -> None:
        """They are left out of means, never averaged in silence."""
        for link in _products(played, "link", Link):
            assert link.no_path == int((~link.has_path).sum())
            values: Float64Array = np.stack([link.abs_y, link.snr, link.bit_rate, link.top_abs_y[:, 0]])
            assert (values[:, ~link.has_path] == 0).all()
            assert (values >= 0).all()

    def test_users_that_no_agent_serves_get_nothing(self, played: Played) -> None:
        """In the last frame the actions are absent."""
        *_, last = _products(played, "link", Link)
        assert (last.tx_beam == -1).all()
        assert (last.abs_y == 0).all()


class AgentConformance(ServiceConformance):
    """Agents: decisions for the actuators they own.

    Example:
        >>> from caviar_services.agent.baselines import LosBeamAgent
        >>> class TestLosBeamAgent(AgentConformance):
        ...     service_class = LosBeamAgent
        >>> TestLosBeamAgent.__test__
        True
    """

    def test_commands_are_sorted_one_per_actuator_and_carrier(self, played: Played) -> None:
        """The link could not tell which of two to obey."""
        for action in _products(played, "action", Action):
            beams = [(c.rx, c.tx, c.carrier) for c in action.commands if isinstance(c, BeamChoice)]
            assert beams == sorted(set(beams))

    def test_beams_exist_in_the_codebooks(self, played: Played) -> None:
        """A codebook has as many beams as its array has elements."""
        for frame, action in zip(played.frames, _products(played, "action", Action), strict=True):
            size = _array_sizes(frame.scene())
            for command in action.commands:
                if isinstance(command, BeamChoice):
                    assert command.tx_beam < size[command.tx]
                    assert command.rx_beam < size[command.rx]

    def test_commands_are_for_declared_actuators(self, played: Played) -> None:
        """Clause 3: a clash of two agents is found before the first frame."""
        owned = played.prepared.actuators
        for action in _products(played, "action", Action):
            for command in action.commands:
                # An agent that serves what others leave owns no beam by name.
                if owned and isinstance(command, BeamChoice):
                    assert any(fnmatchcase(f"beam:{command.rx}", pattern) for pattern in owned)

    def test_the_final_grant_takes_no_action(self, tmp_path: Path) -> None:
        """Clause 16: it carries the last link only."""
        with self.at_start(tmp_path) as service:
            for frame in self.frames_of(service, 0):
                service.step(frame)
            lagged = tuple(item for item in service.inputs if item.lag == 1)
            final = replace(
                samples.granted(lagged, FRAMES, service.run.name), previous=FRAMES - 1, final=True
            )
            assert service.step(final).products == {}


def _held(item: FrameInput) -> FrameInput:
    provenance = replace(item.provenance, status=Status.HELD, age=1, cause="channel was late")
    return FrameInput(provenance, item.header, item.body)


class RecorderConformance(ServiceConformance):
    """Recorders: every product of a frame is on disk, byte for byte.

    Example:
        >>> from caviar_services.recorder.mcap import McapRecorder
        >>> class TestMcapRecorder(RecorderConformance):
        ...     service_class = McapRecorder
        >>> TestMcapRecorder.__test__
        True
    """

    # Two different ones: a recorder that is granted a frame twice has two of it.
    episodes: ClassVar[tuple[int, ...]] = (0, 1)

    def test_it_creates_no_demand_and_no_products(self) -> None:
        """Clause 5."""
        assert self.service_class.outputs == ()
        assert all(not item.required for item in self.service_class.inputs)

    def test_a_recording_gives_back_every_byte(self, played: Played) -> None:
        """Product by product, with its provenance, for both episodes."""
        recording = Recording(played.directory)
        recorded = {(frame.episode, frame.number): frame for frame in recording.frames()}
        assert set(recorded) == {(e, n) for e in self.episodes for n in range(FRAMES)}
        for frame in played.frames:
            products = {p.provenance.topic: p for p in recorded[0, frame.number].products}
            for item in frame.inputs:
                assert item.provenance.status is Status.FRESH
                product = products.pop(item.provenance.topic)
                assert product.provenance == item.provenance
                assert (bytes(product.header), bytes(product.body)) == (item.header, item.body)
            assert not products

    def test_a_frame_is_on_disk_when_its_step_returns(self, tmp_path: Path) -> None:
        """A file that is read before the recorder is closed is what a killed process leaves."""
        with self.at_start(tmp_path) as service:
            for frame in self.frames_of(service, 0)[:2]:
                service.step(frame)
                assert len(list(Recording(service.run.directory).frames())) == frame.number + 1

    def test_absent_and_held_products_are_recorded_as_such(self, tmp_path: Path) -> None:
        """The provenance tells what a consumer got."""
        with self.at_start(tmp_path) as service:
            first, second = self.frames_of(service, 0)[:2]
            service.step(first)
            # The held channel is that of the first frame: its bytes are stored already, and read back below.
            held = [_held(item) for item in first.inputs if item.provenance.topic == "channel"]
            absent = samples.inputs(service.inputs, 1, {"lidar": "lidar was late"})
            lidar = [item for item in absent if item.provenance.topic == "lidar"]
            service.step(replace(second, inputs=(*held, *lidar)))
        _, frame = Recording(service.run.directory).frames()
        status = {item.topic: item.status for item in frame.inputs}
        assert status == {"channel": Status.HELD, "lidar": Status.ABSENT}
        (product,) = frame.products
        assert product.payload == samples.product("channel", 0)


CONFORMANCE: dict[str, type[ServiceConformance]] = {
    "world": WorldConformance,
    "channel": ChannelConformance,
    "sensors": SensorConformance,
    "link": LinkConformance,
    "agent": AgentConformance,
    "recorder": RecorderConformance,
}
"""Conformance class of each role."""
