"""The controller goes down at once and up with patience, from predictions that it is told."""

from __future__ import annotations

import numpy as np

from caviar_services.channel.adaptive.controller import Controller

BUDGET = 1000


def controller(patience: int = 3) -> Controller:
    """Limit: 800 of a budget of 1,000; 720 before going up."""
    return Controller(share=0.8, margin=0.1, patience=patience)


def chosen(control: Controller, *predicted: float, budget: int = BUDGET) -> int:
    return control.choose(predicted, budget).rung


def test_the_first_frame_takes_the_most_accurate_rung_that_fits() -> None:
    assert chosen(controller(), 10, 790, 801) == 1
    assert chosen(controller(), 10, 790, 800) == 2


def test_without_a_budget_it_takes_the_highest() -> None:
    assert chosen(controller(), 10, 1e9, 1e12, budget=0) == 2


def test_a_predicted_miss_leads_down_at_once_as_far_as_needed() -> None:
    control = controller()
    assert chosen(control, 1, 2, 3, 4) == 3
    assert chosen(control, 10, 700, 900, 1000) == 1


def test_up_only_after_enough_frames_with_margin_in_a_row() -> None:
    control = controller()
    assert chosen(control, 10, 900) == 0
    assert [chosen(control, 10, 700) for _ in range(2)] == [0, 0]
    assert chosen(control, 10, 750) == 0, "fits without the margin: the row is broken"
    assert [chosen(control, 10, 700) for _ in range(4)] == [0, 0, 1, 1]


def test_up_by_two_rungs_where_both_had_the_margin() -> None:
    control = controller()
    assert chosen(control, 10, 900, 900) == 0
    assert [chosen(control, 10, 20, 30) for _ in range(3)] == [0, 0, 2]


def test_a_rung_inside_the_margin_is_kept() -> None:
    control = controller()
    assert chosen(control, 10, 700) == 1
    assert {chosen(control, 10, 799) for _ in range(20)} == {1}


def test_where_nothing_fits_the_lowest_is_taken_and_said_not_to_fit() -> None:
    control = controller()
    choice = control.choose([900, 2000], BUDGET)
    assert (choice.rung, choice.fits) == (0, False)
    assert control.choose([700, 2000], BUDGET).fits


def test_a_middle_rung_that_is_slower_than_the_one_above_is_passed_over() -> None:
    """Accuracy and duration need not go together."""
    control = controller()
    assert chosen(control, 10, 900, 500) == 2
    assert chosen(control, 10, 900, 900) == 0


def test_noise_about_the_limit_changes_the_rung_seldom() -> None:
    """10 % noise about the limit itself: without hysteresis every other frame would change."""
    rng = np.random.default_rng(3)
    control, before, changes = controller(patience=10), None, 0
    for predicted in 800 * (1 + 0.1 * rng.normal(size=1000)):
        now = chosen(control, 10, predicted)
        changes += before is not None and now != before
        before = now
    assert changes <= 10


def test_what_is_imposed_is_where_it_goes_on_from() -> None:
    control = controller()
    assert chosen(control, 10, 700) == 1
    control.impose(0)
    assert [chosen(control, 10, 700) for _ in range(4)] == [0, 0, 1, 1]
    control.reset()
    assert chosen(control, 10, 790) == 1
