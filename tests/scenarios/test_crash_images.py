"""A loss of power: runs go on to the undisturbed digest; `crash_images` makes as many images as one likes."""

from __future__ import annotations

import crash_images
import pytest

REASON = crash_images.missing()
pytestmark = pytest.mark.skipif(bool(REASON), reason=f"crash images: {REASON}")


@pytest.mark.exhaustive
def test_a_run_goes_on_from_what_a_loss_of_power_left(capsys: pytest.CaptureFixture[str]) -> None:
    """One image under ``frame``, one under ``periodic``."""
    status = crash_images.main(["--images", "2", "--frames", "100", "--seed", "4"])
    assert status == 0, capsys.readouterr().out


@pytest.mark.exhaustive
@pytest.mark.sumo
@pytest.mark.channel
@pytest.mark.timeout(3600)
def test_thirty_runs_go_on_from_what_a_loss_of_power_left(capsys: pytest.CaptureFixture[str]) -> None:
    smoke = crash_images.main(["--images", "24", "--seed", "5"])
    canyon = crash_images.main(
        ["--images", "8", "--seed", "6", "--scenario", "street-canyon", "--frames", "40"]
    )
    assert (smoke, canyon) == (0, 0), capsys.readouterr().out
