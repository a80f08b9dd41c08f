"""What the tilt of a UAV does to its beams: one flight, an antenna fixed to the body, a level one beside it.

Scenario ``uav-wind``, on the base install; with the extra ``plot`` also a picture, in the directory of the
run or where ``--out`` says. Run as ``python examples/tilted_beams.py [--frames 300] [--out tilt.png]``.
"""

import argparse
import importlib.util
from pathlib import Path

import numpy as np

import caviar
from caviar_protocol.space.coordinates import euler_from_quaternion

parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
parser.add_argument("--frames", type=int, default=300)
parser.add_argument("--out", type=Path, help="the picture; default: tilted-beams.png in the run's directory")
args = parser.parse_args()

run = caviar.open(caviar.run("uav-wind", frames=args.frames))
scene, channel = run["scene"], run["channel"]
t = scene.t_ns / 1e9
tilt = np.degrees([euler_from_quaternion(q)[1] for q in scene.orientation[:, 0]])  # nose down

# The norm of wᴴH for each beam w of a DFT codebook: what it receives of the best transmitting beam.
rows = channel.h.shape[2]
dft = np.exp(2j * np.pi * np.outer(np.arange(rows), np.arange(rows)) / rows) / np.sqrt(rows)
users = [user.rx for user in channel.users]
fixed, level = (
    np.linalg.norm(dft.conj().T @ channel.h[:, users.index(name)], axis=2) for name in ("uav/rx", "uav/level")
)
best = fixed.argmax(axis=1)
# An agent that knows where the UAV is, and not how it leans, takes the beam of the level antenna.
blind = level.argmax(axis=1)
lost = 20 * np.log10(fixed.max(axis=1) / fixed[np.arange(len(t)), blind])
print(
    f"pitch {tilt.min():.1f}° to {tilt.max():.1f}°: "
    f"{len(set(best.tolist()))} of {rows} beams are the best in turn"
)
print(f"without knowing the tilt: {lost.mean():.1f} dB lost in the mean, {lost.max():.1f} dB at most")

if importlib.util.find_spec("matplotlib") is not None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    above, middle, below = figure.subplots(3, sharex=True)
    above.plot(t, tilt, color="black")
    above.set_ylabel("pitch, nose down [°]")
    shift = (np.stack([best, blind]) + rows // 2) % rows - rows // 2  # beam 0, straight ahead, in the middle
    middle.step(t, shift[0], label="best")
    middle.step(t, shift[1], label="as if level")
    middle.set_ylabel("receiving beam")
    middle.legend(loc="upper right")
    for values, name in ((fixed.max(axis=1), "best"), (fixed[np.arange(len(t)), blind], "as if level")):
        below.plot(t, 20 * np.log10(values), label=name)
    below.set_ylabel("|y| [dB]")
    below.set_xlabel("time [s]")
    below.legend(loc="lower right")
    picture = args.out or run.directory / "tilted-beams.png"
    figure.savefig(picture, dpi=110)
    print(f"picture: {picture}")
