"""What holds for recorders, beyond `ServiceConformance`."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from msgspec.structs import replace

from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_services.service import FrameInput, Preparation
from caviar_services.testing import samples
from caviar_services.testing.base import EPISODE_SEED, FRAMES, Played, ServiceConformance


def _held(item: FrameInput) -> FrameInput:
    provenance = replace(item.provenance, status=Status.HELD, age=1, cause="channel was late")
    return FrameInput(provenance, item.header, item.body)


class RecorderConformance(ServiceConformance):
    """Recorders: whatever a frame had is on disk, as it was."""

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
        """What is read without the recorder being closed is what a killed process leaves."""
        service = self.build(tmp_path)
        try:
            service.prepare(Preparation(demand={}, assets=self.street(service, tmp_path / "assets")))
            service.reset(0, EPISODE_SEED, 0)
            for frame in self.frames_of(service, 0)[:2]:
                service.step(frame)
                assert len(list(Recording(service.run.directory).frames())) == frame.number + 1
        finally:
            service.close()

    def test_absent_and_held_products_are_recorded_as_such(self, tmp_path: Path) -> None:
        """The provenance tells what a consumer got."""
        service = self.build(tmp_path)
        try:
            service.prepare(Preparation(demand={}, assets={}))
            service.reset(0, EPISODE_SEED, 0)
            first, second = self.frames_of(service, 0)[:2]
            service.step(first)
            held = [_held(item) for item in first.inputs if item.provenance.topic == "channel"]
            absent = samples.inputs(service.inputs, 1, {"lidar": "lidar was late"})
            lidar = [item for item in absent if item.provenance.topic == "lidar"]
            service.step(replace(second, inputs=(*held, *lidar)))
        finally:
            service.close()
        _, frame = Recording(service.run.directory).frames()
        status = {item.topic: item.status for item in frame.inputs}
        assert status == {"channel": Status.HELD, "lidar": Status.ABSENT}
        (product,) = frame.products
        assert product.payload == samples.product("channel", 0)
