"""The MCAP recorder: what it writes, when it is on disk, and what it says when it cannot write."""

from __future__ import annotations

import gc
import hashlib
import json
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader
from recording_builders import PERIOD_NS, absent, frame, link, product, record, recorder, scene

from caviar_protocol.codec import decode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import AssetError, ProductError, RunError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import FrameEntry, Recording
from caviar_protocol.validation import FIRST_LOOKS
from caviar_services.recorder.base import copy_assets
from caviar_services.recorder.mcap import McapRecorder
from caviar_services.registry import load
from caviar_services.service import FrameInput

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent


def test_it_is_registered_and_takes_every_topic_without_demanding_any():
    cls = load("recorder", "mcap")
    assert cls is McapRecorder
    assert [(i.topic, i.lag, i.required) for i in cls.inputs] == [("*", 0, False)]
    assert cls.outputs == ()


def test_the_mcap_package_reads_channels_schemas_and_unchanged_wire_bytes(tmp_path):
    item = product("link", "link", link(0), 0)
    record(tmp_path, [frame(0, item)])
    with (tmp_path / "recording-0000.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = {channel.topic: (schema, channel, m) for schema, channel, m in reader.iter_messages()}
    schema, channel, message = found["link/link"]
    assert schema.name == "caviar.link/1"
    assert channel.message_encoding == "caviar-product"
    assert message.sequence == 0
    assert hashlib.sha256(message.data).hexdigest() == item.provenance.digest
    length = int.from_bytes(message.data[:8], "little")
    assert message.data[8 : 8 + length] == bytes(item.header)
    assert message.data[8 + length :] == bytes(item.body)
    schema, channel, message = found["frame"]
    assert (schema.name, channel.message_encoding) == ("caviar.frame/1", "msgpack")
    entry = msgspec.msgpack.decode(message.data, type=FrameEntry)
    assert entry.inputs == (item.provenance,)


def test_a_closed_segment_has_an_index_statistics_and_metadata(tmp_path):
    record(tmp_path, frames=4, notes=("on the roof",))
    with (tmp_path / "recording-0000.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        (metadata,) = reader.iter_metadata()
    assert summary.statistics.message_count == 4 * 3
    assert len(summary.chunk_indexes) == 4
    assert all(index.message_index_offsets for index in summary.chunk_indexes)
    content = {key: json.loads(value) for key, value in metadata.metadata.items()}
    assert content["scenario"]["run"]["name"] == "sample"
    assert content["seed"] == 7
    assert content["notes"] == ["on the roof"]
    assert content["versions"]["mcap"]
    assert content["machine"]["cpu_count"] >= "1"
    assert content["started"].endswith("+00:00")


def test_the_provenance_of_every_input_is_recorded_in_canonical_order(tmp_path):
    inputs = [
        product("scene", "world", scene(0), 0),
        absent("lidar", "sensors", "lidar did not answer frame 0"),
        product("link", "b", link(0), 0),
        product("link", "a", link(0), 0),
    ]
    record(tmp_path, [frame(0, *inputs)])
    entries = Recording(tmp_path).frame(0, 0).inputs
    assert [(e.topic, e.source) for e in entries] == [
        ("lidar", "sensors"),
        ("link", "a"),
        ("link", "b"),
        ("scene", "world"),
    ]
    assert entries[0].cause == "lidar did not answer frame 0"


def test_a_missing_digest_is_computed(tmp_path):
    item = product("link", "link", link(0), 0)
    bare = msgspec.structs.replace(item.provenance, digest="")
    record(tmp_path, [frame(0, FrameInput(bare, item.header, item.body))])
    assert Recording(tmp_path).frame(0, 0).inputs[0].digest == item.provenance.digest


def test_a_false_digest_of_a_large_product_is_refused_at_first_and_read_as_damage_later(tmp_path):
    header, body = bytes(300), bytes(1 << 17)

    def large(number: int, digest: str):
        entry = GrantInput(topic="hold", source="s", status=Status.FRESH, frame=number, digest=digest)
        return frame(number, FrameInput(entry, header, body))

    made, right = recorder(tmp_path), payload_digest(header, body)
    for number in range(FIRST_LOOKS - 1):
        made.step(large(number, right))
    with pytest.raises(ProductError, match=f"hold of 's', frame {FIRST_LOOKS - 1}"):
        made.step(large(FIRST_LOOKS - 1, "0" * 64))
    made.step(large(FIRST_LOOKS - 1, right))
    made.step(large(FIRST_LOOKS, "0" * 64))
    made.close()
    (damage,) = Recording(tmp_path).run_digest().damage
    assert f"frame {FIRST_LOOKS}" in damage


def test_a_payload_that_was_never_encoded_is_written_as_its_wire_bytes(tmp_path):
    item = product("link", "link", link(0), 0)
    record(tmp_path, [frame(0, FrameInput(item.provenance, payload=link(0)))])
    (stored,) = Recording(tmp_path).frame(0, 0).products
    assert (bytes(stored.header), bytes(stored.body)) == (bytes(item.header), bytes(item.body))


def test_a_held_product_is_stored_once(tmp_path):
    record(
        tmp_path,
        [
            frame(0, product("link", "link", link(0), 0)),
            *(
                frame(number, product("link", "link", link(0), 0, Status.HELD, used_in=number))
                for number in (1, 2)
            ),
        ],
    )
    with (tmp_path / "recording-0000.mcap").open("rb") as stream:
        counted = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert counted.count("link/link") == 1
    assert Recording(tmp_path).product(0, 2, "link", "link") == link(0)


def test_a_held_product_that_was_never_stored_is_stored_when_held(tmp_path):
    record(
        tmp_path,
        [
            frame(0, absent("link", "link", "late")),
            frame(1, product("link", "link", link(0), 0, Status.HELD, used_in=1)),
        ],
    )
    assert Recording(tmp_path).product(0, 1, "link", "link") == link(0)


def test_a_late_product_stands_under_its_true_frame_beside_the_fresh_one(tmp_path):
    late = product("link", "link", link(0), 0, Status.LATE, used_in=1)
    record(
        tmp_path,
        [
            frame(0, absent("link", "link", "late")),
            frame(1, product("link", "link", link(1), 1), late),
            frame(2, product("link", "link", link(1), 1, Status.HELD, used_in=2)),
        ],
    )
    recording = Recording(tmp_path)
    first, second = recording.frame(0, 1).products
    assert (first.provenance.frame, first.provenance.status) == (0, Status.LATE)
    assert first.payload == link(0)
    assert second.payload == link(1)
    assert recording.product(0, 1, "link", "link") == link(1)
    assert recording.product(0, 2, "link", "link") == link(1)


def test_log_time_grows_over_episodes_that_each_start_at_zero(tmp_path):
    made = recorder(tmp_path)
    for episode in (0, 1, 2):
        made.reset(episode, 7, 0)
        for number in range(3):
            made.step(frame(number, episode=episode))
        made.end_episode(3)
    made.close()
    with (tmp_path / "recording-0000.mcap").open("rb") as stream:
        times = [m.log_time for _, channel, m in make_reader(stream).iter_messages(topics=["frame"])]
    assert times == [k * PERIOD_NS for k in range(9)]
    assert [(f.episode, f.number) for f in Recording(tmp_path).frames()] == [
        (e, k) for e in range(3) for k in range(3)
    ]


def test_segments_rotate_by_size_and_by_frames(tmp_path):
    record(tmp_path / "frames", frames=7, segment_frames=3)
    files = sorted(p.name for p in (tmp_path / "frames").glob("*.mcap"))
    assert files == [f"recording-{i:04d}.mcap" for i in range(3)]
    record(tmp_path / "size", frames=20, segment_mib=0.01)
    sizes = [p.stat().st_size for p in (tmp_path / "size").glob("*.mcap")]
    assert len(sizes) > 3
    assert max(sizes) < 0.03 * 2**20
    assert len(Recording(tmp_path / "size")) == 20


def test_scenery_is_copied_with_its_digest(tmp_path):
    mesh = tmp_path / "cache" / "abc"
    mesh.parent.mkdir()
    mesh.write_bytes(b"ply\n")
    record(tmp_path / "run", [], assets={"scenery/meshes/wall.ply": mesh})
    recording = Recording(tmp_path / "run")
    assert recording.assets["scenery/meshes/wall.ply"].read_bytes() == b"ply\n"
    assert recording.metadata.assets[0].digest == hashlib.sha256(b"ply\n").hexdigest()


@pytest.mark.parametrize("name", ["../outside.ply", "/etc/outside.ply", "a/../../outside.ply"])
def test_an_asset_name_that_leads_out_of_the_recording_is_refused(tmp_path, name):
    (tmp_path / "mesh").write_bytes(b"")
    with pytest.raises(AssetError, match="leads out"):
        copy_assets({name: tmp_path / "mesh"}, tmp_path / "run" / "assets")


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_every_compression_is_read_back_and_gives_the_same_digest(tmp_path, compression):
    record(tmp_path / compression, compression=compression)
    record(tmp_path / "plain")
    report = Recording(tmp_path / compression).run_digest()
    assert report.damage == ()
    assert report.digest == Recording(tmp_path / "plain").run_digest().digest


def test_a_directory_that_holds_a_recording_is_refused(tmp_path):
    record(tmp_path)
    with pytest.raises(RunError, match=r"recording-0000\.mcap.*--out"):
        recorder(tmp_path)


def test_a_directory_that_cannot_be_made_is_named_with_errno(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"file.*Not a directory \(errno 20\)"):
        recorder(tmp_path / "file" / "run")


_FULL = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from recording_builders import recorder
folder = Path(sys.argv[1])
mesh = folder / "mesh.ply"
mesh.write_bytes(bytes(50_000))
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
recorder(folder / "run", assets={"wall.ply": mesh})
"""


def test_a_copy_of_scenery_that_fails_names_its_target(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", _FULL, str(tmp_path), str(HERE)], capture_output=True, text=True, timeout=60
    )
    assert f"cannot write {tmp_path}/run/assets/wall.ply: File too large (errno 27)" in done.stderr


_LIMITED = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from recording_builders import frame, recorder
from caviar_protocol.errors import RunError
made = recorder(Path(sys.argv[1]))
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
for number in range(1000):
    try:
        made.step(frame(number))
    except RunError as error:
        print(number, error)
        break
try:
    made.step(frame(number))
except RunError as error:
    print("again", error)
made.close()
"""


def test_a_write_that_fails_ends_the_run_with_path_and_errno_and_leaves_a_readable_file(tmp_path):
    """The file size limit of the process stands for a full disk: write() fails half-way."""
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, str(tmp_path), str(HERE)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    first, again = done.stdout.splitlines()
    assert "recording-0000.mcap: File too large (errno 27)" in first
    assert again.removeprefix("again ") == first.split(" ", 1)[1]
    recording = Recording(tmp_path)
    acknowledged = int(first.split()[0])
    assert acknowledged > 0
    # The write may have broken off after the frame, in its index.
    assert len(recording) in (acknowledged, acknowledged + 1)
    assert not recording.complete


_ENDLESS = """
import sys
from itertools import count
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from recording_builders import frame, recorder
made = recorder(Path(sys.argv[1]), segment_frames=40)
for number in count():
    made.step(frame(number))
    print(number, flush=True)
"""


def test_after_kill_9_every_acknowledged_frame_is_readable(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", _ENDLESS, str(tmp_path), str(HERE)], stdout=subprocess.PIPE, text=True
    )
    with process:
        for line in process.stdout:
            if int(line) >= 100:
                break
        process.send_signal(signal.SIGKILL)
        acknowledged = int([line, *process.stdout.readlines()][-1])
    recording = Recording(tmp_path)
    assert not recording.complete
    assert len(recording) in (acknowledged + 1, acknowledged + 2)
    assert len(list(tmp_path.glob("*.mcap"))) >= 3
    for number, stored in enumerate(recording.frames()):
        assert stored.number == number
        assert [p.digest for p in stored.products] == [e.digest for e in stored.inputs]
    assert recording.run_digest().damage == ()
    assert recording.product(0, acknowledged, "link", "link") == link(acknowledged)


def test_memory_does_not_grow_with_frames(tmp_path):
    """8 products of 1.3 kB a frame; rotation gives back what a segment's index took."""
    made = recorder(tmp_path, segment_frames=500)
    topics = ("channel", "link", "action", "and", "five", "that", "hold", "anything")
    header, body = bytes(300), bytes(1000)
    digest = payload_digest(header, body)

    def step(number: int) -> None:
        made.step(
            frame(
                number,
                *(
                    FrameInput(
                        GrantInput(topic=t, source="s", status=Status.FRESH, frame=number, digest=digest),
                        header,
                        body,
                    )
                    for t in topics
                ),
            )
        )

    for number in range(400):
        step(number)
    gc.collect()
    tracemalloc.start()
    try:
        levels = []
        for number in range(400, 2400):
            step(number)
            if number % 500 == 399:
                gc.collect()
                levels.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
        made.close()
    assert len(levels) == 4
    assert levels[-1] - levels[0] < 20 * 1500  # bytes over 1,500 frames


def test_recorded_bytes_decode_with_the_plain_codec(tmp_path):
    record(tmp_path, frames=1)
    for stored in Recording(tmp_path).frame(0, 0).products:
        decoded = decode_payload(stored.provenance.topic, stored.header, stored.body)
        assert decoded == stored.payload
