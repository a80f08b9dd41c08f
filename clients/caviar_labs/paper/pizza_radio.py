"""Table of what every beam achieves in every place of the neighbourhood, in which the agents are trained.

The run's own channel and link give the figures: receivers stand on a grid, and their rays are traced at once,
which takes seconds where a flight over the same places would take minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from caviar_clients.session.connected import open_session
from caviar_clients.session.prepared import prepare
from caviar_labs.paper.pizza_town import HEIGHT_M, is_free
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import DeviceSpec, Scenario
from caviar_protocol.scenario.schema import ServiceSpec
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Channel
from caviar_services.link.base import channels_of
from caviar_services.link.beam_scores import sweep_users
from caviar_services.link.beams import BeamLinkSettings
from caviar_services.link.link_budget import LinkBudget

_LOW_M, _HIGH_M = np.array([-82.5, -47.5]), np.array([82.5, 47.5])
_GRID_WALL_M = 1.5
"""[m] that receivers stay away from walls: the clearance of the drone."""


@dataclass(frozen=True, eq=False)
class RadioTable:
    """Spectral efficiency of every beam, receiver by receiver."""

    places: Float64Array
    """x and y [m], Shape ``[P, 2]``."""
    efficiency: Float64Array
    """[bit/s/Hz], Shape ``[P, beams]``; 0 where no path leads to."""
    straight: Int64Array
    """Beam along the straight line, Shape ``[P]``."""
    los: BoolArray
    """Shape ``[P]``."""
    grid: Int64Array
    """Index of the place nearest to each point of a grid, Shape ``[X, Y]``."""
    cell_m: float
    """Between points of that grid."""

    def nearest(self, places: Float64Array) -> Int64Array:
        """Find the receiver that stands for places.

        Args:
            places: x and y [m], Shape ``[N, 2]``.

        Returns:
            Indices, Shape ``[N]``.
        """
        at = np.rint((places - _LOW_M) / self.cell_m).astype(np.int64)
        x, y = np.clip(at, 0, np.array(self.grid.shape) - 1).T
        found: Int64Array = self.grid[x, y]
        return found


def radio_table(scenario: str | Path, cell_m: float) -> RadioTable:
    """Trace the rays to receivers on a grid over the neighbourhood.

    Args:
        scenario: The experiment's.
        cell_m: Between receivers.

    Raises:
        ScenarioError: The scenario is wrong.
        RunError: The run ended.
    """
    xs, ys = (np.arange(a, b + 1e-9, cell_m) for a, b in zip(_LOW_M, _HIGH_M, strict=True))
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
    places = grid[is_free(grid, _GRID_WALL_M)]
    standing = _standing(prepare(Path(scenario)).scenario, places)
    wanted = (Input(topic="scene"), Input(topic="channel", parts=("h",)))
    with open_session(standing, "beams", wanted) as session:
        frame = session.reset(seed=0)
    scene, channel = frame.scene(), frame.only("channel", Channel)
    if channel is None:
        raise RunError("the channel service gave no channel for the grid of receivers")
    settings = BeamLinkSettings()
    budget = LinkBudget.of(scene, channel.carriers, settings.noise_figure_db, settings.temperature_k)
    channels = channels_of(channel, budget.users)
    swept = np.zeros((len(places), beam_count(budget.users[0].tx.array)))
    for group in sweep_users(budget.users, channels.h):
        swept[list(group.users)] = np.reshape(group.abs_y, (len(group.users), -1))
    ahead = zip(budget.users, *directions(scene, budget.users), strict=True)
    straight = [straight_beams(pair.tx.array, to, pair.rx.array, back)[0] for pair, to, back in ahead]
    # Users come in the order of their names.
    order = np.argsort([int(pair.rx.name.removeprefix("at")) for pair in budget.users])
    efficiency = np.log2(1 + swept**2 * budget.power_over_noise[:, None])
    return RadioTable(
        places=places,
        efficiency=efficiency[order],
        straight=np.array(straight)[order],
        los=np.asarray(channels.los)[order],
        grid=_nearest(grid, places),
        cell_m=cell_m,
    )


def _standing(scenario: Scenario, places: Float64Array) -> Scenario:
    """One frame of the same scenario, with a receiver at each place and nothing that flies."""
    transmitters = [device for device in scenario.devices if device.role == "tx"]
    receivers = [
        DeviceSpec(name=f"at{index}", kind="antenna", role="rx", position_m=(x, y, HEIGHT_M))
        for index, (x, y) in enumerate(places.tolist())
    ]
    services = scenario.services
    scenery = {"scenery": services["world"].settings["scenery"]}
    kept: dict[str, ServiceSpec] = {
        "world": replace(services["world"], use="trajectory", settings=scenery),
        "channel": services["channel"],
        "link": services["link"],
        "beams": replace(services["beams"], users=("*",)),
    }
    run = replace(scenario.run, frames=1, record=())
    return replace(scenario, run=run, services=kept, devices=(*transmitters, *receivers))


def _nearest(grid: Float64Array, places: Float64Array) -> Int64Array:
    from scipy.spatial import cKDTree  # type: ignore[import-untyped]

    found: Int64Array = cKDTree(places).query(grid)[1].astype(np.int64)
    return found
