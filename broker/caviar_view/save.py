"""One HTML file that shows a recording without a server: the page with its answers inside."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Callable
from importlib import resources

from caviar_protocol.errors import CaviarError, RecordingError
from caviar_view.answers import Answer, Answers

Progress = Callable[[int, int], None]
"""Called with how many frames are in the page, of how many."""

# Topics in the order in which a page can do without them, the last ones first.
_TOPICS = ("scene", "link", "channel", "action", "lidar", "camera", "depth")

# What a page gets of each frame, richest first: points of LIDARs, paths of a pair, width of pictures [px].
_DETAILS = (
    {"points": "6000", "paths": "25", "pixels": "320"},
    {"points": "2000", "paths": "15", "pixels": "160"},
    {"points": "800", "paths": "8", "pixels": "80"},
)
_SAMPLE = 5
_LOBES = 100
_LANES = 40
"""Frames of the clock that a page shows at once (clients/view/src/panels/clock.ts)."""
_LANE_BYTES = 300
_LOBE_BYTES = 12_000
FRAMES_FIRST = 200
"""Frames below which a page is rather saved with fewer points than with fewer frames."""


def saved_page(answers: Answers, limit: int, progress: Progress = lambda done, of: None) -> tuple[bytes, int]:
    """Make the page.

    Args:
        answers: Of the recording.
        limit: Bytes that it has at most.
        progress: Called after each frame.

    Returns:
        The page, and k where every k-th frame is in it.

    Raises:
        RecordingError: Not even a few frames fit.
    """
    page = _page()
    about = answers.about()
    kept = {f"meshes/{mesh['id']}": _packed(answers.get(f"meshes/{mesh['id']}")) for mesh in about["meshes"]}
    kept |= {f"meshes/{name}": _packed(answers.get(f"meshes/{name}")) for name in about["assets"].values()}
    if about["radio_map"]:
        kept["radio-map"] = _packed(answers.get("radio-map"))
    for user in range(len(answers.users())):
        kept[f"curves/{user}"] = _packed(answers.get("curves", {"user": str(user)}))
    room = limit - len(page) - sum(map(len, kept.values())) - _LOBES * _LOBE_BYTES
    first, end = answers.frames.first, answers.frames.end
    detail, every = _fitting(answers, room, first, end)
    for place in range(first, end, _LANES * every):
        query = {"first": str(place), "count": str(_LANES), "every": str(every)}
        kept[f"clock/{place}"] = _packed(answers.get("clock", query))
    places, lobes = range(first, end, every), 0
    for done, place in enumerate(places, 1):
        kept |= _frame(answers, place, detail)
        for device, beam in sorted(answers.beams_of(place)):
            # A lobe is that of the device's array: the same in all frames.
            if (name := f"lobes/{device}/{beam}") not in kept and lobes < _LOBES:
                query = {"device": device, "beam": str(beam)}
                kept[name], lobes = _packed(answers.get(f"frames/{place}/lobes", query)), lobes + 1
        progress(done, len(places))
    about |= {"every": every, "controls": False, "beside": False}
    kept["about"] = _packed(Answer(json.dumps(about).encode(), ""))
    content = page.replace(_MARK, json.dumps(kept).replace("<", "\\u003c").encode())
    if len(content) > limit:
        raise RecordingError(
            f"the page has {len(content) / 1e6:.1f} MB, more than {limit / 1e6:.1f}; allow more with --limit"
        )
    return content, every


def _fitting(answers: Answers, room: int, first: int, end: int) -> tuple[dict[str, str], int]:
    """Detail of frames, and which of them, so that they have room."""
    chosen: tuple[dict[str, str], int] | None = None
    sample = sorted({first + i * (end - first) // _SAMPLE for i in range(_SAMPLE)})
    for detail in _DETAILS:
        frames = [_frame(answers, place, detail).items() for place in sample]
        sizes = [_LANE_BYTES + sum(len(name) + len(text) + 8 for name, text in frame) for frame in frames]
        count = int(room / (1.15 * max(max(sizes), 1)))
        if count < 1:
            continue
        every = -(-(end - first) // count)
        chosen = detail, every
        if every == 1 or (end - first) // every >= FRAMES_FIRST:
            break
    if chosen is None:
        raise RecordingError("not even one frame fits into the page; allow more with --limit")
    return chosen


def _frame(answers: Answers, place: int, detail: dict[str, str]) -> dict[str, str]:
    found = {f"frames/{place}": answers.get(f"frames/{place}")}
    topics = set(answers.topics_of(place))
    for topic in _TOPICS:
        if topic in topics:
            found[f"frames/{place}/{topic}"] = answers.get(f"frames/{place}/{topic}", detail)
    return {name: _packed(answer) for name, answer in found.items()}


def _packed(answer: Answer) -> str:
    return base64.b64encode(gzip.compress(answer.content, 9, mtime=0)).decode()


_MARK = b'"the answers stand here"'


def _page() -> bytes:
    """The page with its scripts and styles inside, and a policy that allows these alone."""
    folder = resources.files("caviar_view") / "page"
    page, style, script = (
        (folder / name).read_text("utf-8") for name in ("index.html", "viewer.css", "viewer.js")
    )
    script = script.replace("</script", "<\\/script")
    hashes = {
        kind: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        for kind, text in (("script", script), ("style", style))
    }
    policy = (
        f"default-src 'none'; script-src 'sha256-{hashes['script']}'; style-src 'sha256-{hashes['style']}'; "
        "img-src blob: data:; base-uri 'none'; form-action 'none'"
    )
    head = f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<style>{style}</style>'
    data = f'<script type="application/json" id="saved">{_MARK.decode()}</script>'
    for tag, inside in (
        ('<link rel="stylesheet" href="viewer.css">', head),
        (
            '<script type="module" src="viewer.js"></script>',
            f'{data}\n<script type="module">{script}</script>',
        ),
    ):
        if page.count(tag) != 1:
            raise CaviarError(f"the page of this installation has no {tag}; install it again")
        page = page.replace(tag, inside)
    return page.encode()
