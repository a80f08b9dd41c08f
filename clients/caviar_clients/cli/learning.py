"""``caviar policy``: policies are trained, exported, evaluated, and swapped in a running run."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from caviar_clients.cli.shared import counted, print_line, progress_bar, require_writable, write_json
from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.host import install_command

if TYPE_CHECKING:
    from caviar_clients.learning.classification import Classification
    from caviar_clients.learning.evaluate import Evaluation, Interval
    from caviar_clients.learning.experiment import Experiment
    from caviar_clients.learning.training import Progress, SeedResult

app = typer.Typer()
ALGORITHMS = ("dqn", "ppo", "a2c")


@app.command("train")
def train_command(
    experiment: Annotated[Path, typer.Argument(help="TOML file of the experiment", show_default=False)],
    out: Annotated[Path, typer.Option(help="folder in which the experiment's own is made")] = Path(
        "training"
    ),
    jobs: Annotated[
        int | None, typer.Option(min=1, help="seeds at a time; by default as many as there are cores")
    ] = None,
) -> None:
    """Train the seeds of an experiment, or go on with what was interrupted: policies, curves, checkpoints."""
    from caviar_clients.learning.campaign import check_folder, reached, train_experiment
    from caviar_clients.learning.classification import Classification, load_any_experiment

    console, loaded = Console(), load_any_experiment(experiment)
    folder = check_folder(loaded, out)
    if any(reached(loaded, out).values()):
        print_line(console, f"{folder} goes on: {_steps_of(loaded, out)}")
    try:
        with training_bars(console, loaded) as report:
            results = train_experiment(loaded, out, jobs or cores(), report)
    except KeyboardInterrupt:
        print_line(
            console,
            f"stopped; caviar policy train {experiment} --out {out} goes on: {_steps_of(loaded, out)}",
        )
        raise
    if isinstance(loaded, Classification):
        from caviar_clients.cli.rankings import training_table

        console.print(training_table(loaded, folder, results))
        return
    console.print(_results_table(loaded, folder, results))
    if any(result.steps != loaded.experiment.steps for result in results):
        print_line(console, _rollouts(loaded))


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def training_bars(
    console: Console, experiment: Experiment | Classification
) -> Iterator[Callable[[Progress], None]]:
    """Show a bar with the time left for each seed, and one for all of them.

    Args:
        console: Where they are drawn.
        experiment: What is trained.

    Yields:
        What takes the progress of a seed.
    """
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    from caviar_clients.learning.classification import Classification

    subject, tasks = experiment.experiment, dict[int, Any]()
    unit = "epochs" if isinstance(experiment, Classification) else "steps"
    columns = (MofNCompleteColumn(), unit, TimeRemainingColumn(), "{task.fields[reward]}")
    with progress_bar(console, *columns) as bar:
        together: list[Any] = []
        done = dict.fromkeys(subject.seeds, 0)

        def report(progress: Progress) -> None:
            seed, steps, total = progress.seed, progress.steps, progress.total
            if not together:
                together.append(bar.add_task(subject.name, total=total * len(subject.seeds), reward=""))
                if (
                    progress.rollout
                    and not isinstance(experiment, Classification)
                    and total != experiment.experiment.steps
                ):
                    print_line(console, f"{total:,} steps a seed: {_rollouts(experiment, progress.rollout)}")
            if seed not in tasks:
                tasks[seed] = bar.add_task(f"seed {seed}", total=total, completed=steps, reward="")
                # What an earlier call has trained says nothing about the time left.
                bar.reset(together[0], completed=sum(done.values()) + steps)
            reward = "" if progress.mean_reward is None else f"reward {progress.mean_reward:.4g}"
            if progress.figures:
                reward = f"top-10 {progress.figures['top_10']:.1%}"
            bar.update(tasks[seed], completed=steps, reward=reward)
            done[seed] = steps
            bar.update(together[0], completed=sum(done.values()))

        yield report


def _rollouts(experiment: Experiment, rollout: int = 0) -> str:
    """Reason for more steps than the file asks for."""
    algorithm, members = experiment.algorithm, experiment.environment.members
    what = "n_steps" if hasattr(algorithm, "n_steps") else "train_freq"
    numbers = f" = {rollout // members:,} × {members:,}" if rollout else ""
    return (
        f"{algorithm.called} learns from {what} × members{numbers} steps at once, and the "
        f"{experiment.experiment.steps:,} of the file are no multiple of these"
    )


def _steps_of(experiment: Experiment | Classification, root: Path) -> str:
    """Rest of each seed, in words."""
    from caviar_clients.learning.campaign import reached
    from caviar_clients.learning.classification import Classification
    from caviar_clients.learning.training import read_result

    folder = root / experiment.experiment.name
    unit = "epoch" if isinstance(experiment, Classification) else "step"
    return ", ".join(
        f"seed {seed} is done" if read_result(folder, seed) else f"seed {seed} from {unit} {steps:,}"
        for seed, steps in reached(experiment, root).items()
    )


def _results_table(experiment: Experiment, folder: Path, results: list[SeedResult]) -> Table:
    from caviar_clients.learning.training import CURVES, MODEL, POLICY, seed_folder

    table = Table(title=f"{experiment.experiment.name}: {experiment.algorithm.called} in {folder}")
    for name in ("seed", "steps", "time", "reward of an episode"):
        table.add_column(name, justify="right")
    table.add_column("files", overflow="fold")
    for result in results:
        mine = seed_folder(folder, result.seed).relative_to(folder)
        table.add_row(
            str(result.seed),
            f"{result.steps:,}",
            f"{result.seconds:.0f} s",
            "" if result.mean_reward is None else f"{result.mean_reward:.4g}",
            f"{mine}/: {MODEL if result.policy is None else POLICY}, {CURVES}/",
        )
    return table


@app.command("export")
def export_command(
    model: Annotated[Path, typer.Argument(help="zip file that Stable-Baselines3 saved", show_default=False)],
    policy: Annotated[Path, typer.Argument(help="ONNX file to write", show_default=False)],
    algorithm: Annotated[str, typer.Option(help="that trained it: " + ", ".join(ALGORITHMS))],
    on: Annotated[str, typer.Option("--on", help="scenario that it was trained on, by name or file")],
    users: Annotated[str, typer.Option(help="receivers that it serves, with * and ?")] = "*",
    steps: Annotated[int, typer.Option(min=0, help="of training, for the card")] = 0,
    normalization: Annotated[
        Path | None, typer.Option(help="statistics of the VecNormalize that it was trained behind")
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="the model is from you: to read it runs what is pickled in it")
    ] = False,
) -> None:
    """Write a trained model as an ONNX policy, with its card, for the agent `policy`."""
    from caviar_clients.envs.base import BeamSelectionEnv
    from caviar_clients.learning.export import export_policy

    if algorithm.lower() not in ALGORITHMS:
        raise ScenarioError(f"--algorithm {algorithm}: write one of {', '.join(ALGORITHMS)}")
    try:
        import stable_baselines3
    except ImportError as error:
        raise SetupError(
            f"the model is read by Stable-Baselines3; run: {install_command('learning')}"
        ) from error
    if not model.is_file():
        raise ScenarioError(f"{model}: there is no such file; give the zip file that model.save() wrote")
    if not trust:
        raise ScenarioError(
            f"{model} is a model of Stable-Baselines3, and to read one runs the code that is pickled in it; "
            "give --trust if you know who wrote it"
        )
    try:
        trained = getattr(stable_baselines3, algorithm.upper()).load(model, device="cpu")
    except Exception as error:  # whatever a file that is no model makes it raise
        raise ScenarioError(
            f"{model} cannot be read as a model of {algorithm.upper()}: {error}; is it of another algorithm?"
        ) from error
    spaces = getattr(trained.observation_space, "spaces", None)
    if not spaces:
        raise ScenarioError(
            f"{model} observes {trained.observation_space}, no parts by name; train it with the policy "
            "'MultiInputPolicy' on caviar/BeamSelection-v0"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = BeamSelectionEnv(on, observe=tuple(spaces), users=users)
    wanted, found = trained.action_space, env.action_space
    # Bounds are looked at by `export_policy`, which says what they come from.
    if wanted != found or _spaces(trained.observation_space) != _spaces(env.observation_space):
        raise ScenarioError(
            f"{model} was trained for actions {wanted} and {_spaces(trained.observation_space)}, and {on} "
            f"has {found} and {_spaces(env.observation_space)}; name scenario and users of its training"
        )
    if normalization is not None:
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

        try:
            trained.set_env(VecNormalize.load(str(normalization), DummyVecEnv([lambda: env])))
        except Exception as error:  # whatever a file that is none makes it raise
            raise ScenarioError(
                f"{normalization} cannot be read as statistics of VecNormalize: {error}; give the file that "
                "its save() wrote"
            ) from error
    card = export_policy(trained, env, policy, steps=steps or int(trained.num_timesteps))
    typer.echo(f"{policy}: {card.algorithm}, observes {', '.join(card.observe)}, {policy.stat().st_size:,} B")


def _spaces(space: Any) -> str:
    return ", ".join(f"{name} {box.shape}" for name, box in space.spaces.items())


@app.command("evaluate")
def evaluate_command(
    policies: Annotated[
        list[Path],
        typer.Argument(
            metavar="POLICY...",
            help="ONNX file with a card; on a dataset several, or folders of trainings",
            show_default=False,
        ),
    ],
    on: Annotated[str, typer.Option("--on", help="scenario, by name or file; or folder of a dataset")],
    seeds: Annotated[int, typer.Option(min=1, help="number of seeds")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="the first; none of training's")] = 1000,
    episodes: Annotated[int, typer.Option(min=1, help="of each seed")] = 1,
    users: Annotated[str, typer.Option(help="receivers that it serves, with * and ?")] = "*",
    against: Annotated[
        list[str] | None,
        typer.Option(help="agent to compare with, may be repeated; by default all that need no settings"),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="AGENT.SETTING=VALUE, as in --set fingerprint.file=runs/RUN"),
    ] = None,
    trained_on: Annotated[
        Path | None,
        typer.Option(help="dataset of the training, which baselines learn from; by default that of --on"),
    ] = None,
    outage_db: Annotated[
        float, typer.Option(help="on a dataset: SNR below which a user is out of service, in dB")
    ] = 0.0,
    json: Annotated[Path | None, typer.Option(help="write the figures there too")] = None,
) -> None:
    """Hold policies against los-beam, the optimum and other agents, LOS and NLOS apart.

    In a scenario policies play episodes; on a dataset they rank the beams of its recorded users."""
    from caviar_clients.cli.rankings import evaluate_rankings, is_dataset
    from caviar_clients.learning.evaluate import BASELINES, evaluate

    if is_dataset(on):
        given = {"--against": against, "--set": settings}
        if wrong := [name for name, value in given.items() if value]:
            raise ScenarioError(
                f"{wrong[0]}: on a dataset, {on}, all baselines are compared with; leave it out"
            )
        evaluate_rankings(Console(), policies, on, trained_on, users, outage_db, json)
        return
    if len(policies) > 1:
        raise ScenarioError(
            f"{len(policies)} policies: in a scenario, {on}, one is evaluated; --on DATASET takes more"
        )
    (policy,) = policies
    rivals: dict[str, dict[str, Any]] = {name: {} for name in (BASELINES if against is None else against)}
    rivals |= _settings_of(settings or [])
    require_writable(json)
    chosen = range(first_seed, first_seed + seeds)
    console = Console()
    with progress_bar(console, "{task.completed}/{task.total} episodes", transient=True) as bar:
        task = bar.add_task("", total=seeds * episodes)
        made = evaluate(
            policy, on, chosen, episodes, lambda done: bar.update(task, completed=done), rivals, users
        )
    print_line(console, f"{made.policy} on {made.scenario}, {counted(seeds * episodes, 'episode')}")
    for table in _evaluation_tables(made):
        console.print(table)
    if json is not None:
        played = [seed for seed in chosen for _ in range(episodes)]
        write_json(
            json,
            {
                "frames": dict(made.frames),
                "abs_y": {m: {k: vars(mean) for k, mean in means.items()} for m, means in made.found.items()},
                "spectral_efficiency": {m: vars(mean) for m, mean in made.efficiency.items()},
                "pilots": dict(made.pilots),
                "episodes": {"seeds": played, "abs_y": dict(made.by_episode)},
                "policy_minus": {
                    m: {k: vars(made.difference(m, k)) for k in means}
                    for m, means in made.found.items()
                    if m != "policy"
                },
            },
        )


def _evaluation_tables(made: Evaluation) -> Iterator[Table]:
    """|y| by frames, by station where there are several, and what pilots cost: 80 columns hold no more."""
    from caviar_clients.learning.evaluate import KINDS

    yield _gains(made, KINDS, "frames")
    # Of each a table: |y| of carriers is orders of magnitude apart.
    for station in (kind for kind in made.frames if kind not in KINDS):
        yield _gains(made, (station,), "station")
    title = "mean |y|² over random and below the optimum, pilots, and what these leave"
    costs = Table(title=title, title_justify="left")
    costs.add_column("", overflow="fold")
    costs.add_column("gain dB", justify="right", no_wrap=True)
    costs.add_column("loss dB", justify="right", no_wrap=True)
    costs.add_column("pilots a frame", justify="right", no_wrap=True)
    costs.add_column("bit/s/Hz left", justify="right", no_wrap=True)
    for method in made.found:
        gain = _decibels(made.power[method], made.power["random"])
        loss = _decibels(made.power["optimum"], made.power[method])
        costs.add_row(method, gain, loss, f"{made.pilots[method]:.4g}", _short(made.efficiency[method]))
    yield costs


def _gains(made: Evaluation, kinds: Sequence[str], by: str) -> Table:
    exponent = _common_exponent([means[kind].mean for means in made.found.values() for kind in kinds])
    unit = f" in 10{str(exponent).translate(_RAISED)}" if exponent else ""
    gains = Table(title=f"mean |y|{unit}, by {by}", title_justify="left")
    gains.add_column("", overflow="fold")
    for kind in kinds:
        gains.add_column(f"{kind} ({made.frames[kind]:,})", justify="right", no_wrap=True)
    for method, means in made.found.items():
        gains.add_row(method, *(_short(means[kind], exponent) for kind in kinds))
    return gains


def _decibels(power: float, reference: float) -> str:
    return f"{10 * math.log10(power / reference):.1f}" if power > 0 and reference > 0 else ""


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _common_exponent(values: Sequence[float]) -> int:
    """The power of ten, a multiple of 3, in which the largest value is from 1 to 1000; 0: none is needed."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    if largest == 0 or 0.01 <= largest < 10_000:
        return 0
    return 3 * math.floor(math.log10(largest) / 3)


def _short(found: Interval, exponent: int = 0) -> str:
    """A mean and its interval in a power of ten; of what is far below that, one digit."""
    factor = 10.0**exponent
    mean, half_width = found.mean / factor, found.half_width / factor
    digits = 4 if not abs(mean) < 1e-3 else 1
    if found.episodes < 2:
        return f"{mean:.{digits}g}"
    return f"{mean:.{digits}g} ± {half_width:.{1 if abs(half_width) < 1e-3 else 2}g}"


def _settings_of(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Settings of agents, from ``AGENT.SETTING=VALUE`` each."""
    from caviar_clients.replay.plan import typed
    from caviar_services.registry import load

    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        path, equals, value = text.partition("=")
        agent, dot, key = path.strip().partition(".")
        if not (equals and dot and agent and key and value.strip()):
            raise ScenarioError(
                f"--set {text}: write agent, setting and value, as in --set ucb.discount=0.98"
            )
        found.setdefault(agent, {})[key] = value.strip()
    return {agent: typed(changes, load("agent", agent).Settings) for agent, changes in found.items()}


@app.command("swap")
def swap_command(
    policy: Annotated[Path, typer.Argument(help="ONNX file of the policy", show_default=False)],
    run: Annotated[
        Path | None, typer.Option(help="directory of the run; by default the newest in ./runs")
    ] = None,
    agent: Annotated[str, typer.Option(help="name of the agent; may be left out where there is one")] = "",
    wait: Annotated[float, typer.Option(help="seconds that the agent may take", min=0)] = 30.0,
) -> None:
    """Give an agent of a running run another policy; the run goes on meanwhile."""
    from caviar_broker.policies import awaited_outcome, offer_policy
    from caviar_clients.cli.remote import RUNS, newest_run

    directory = run if run is not None else newest_run(RUNS, f"caviar policy swap {policy} --run RUN")
    try:
        content = policy.read_bytes()
    except OSError as error:
        raise RunError(
            f"{policy} cannot be read: {error.strerror}; give the ONNX file of a policy"
        ) from error
    name, digest = offer_policy(directory, agent, content)
    found = awaited_outcome(directory, name, digest, wait)
    if found["state"] == "refused":
        raise RunError(f"agent {name!r} refuses {policy}, and stays with its policy: {found['reason']}")
    if found["state"] == "offered":
        raise RunError(
            f"agent {name!r} has not decided a frame with {policy} within {wait:g} s, and will as soon "
            f"as it can: caviar status {directory} says what the run waits for"
        )
    typer.echo(f"{name} serves {policy} (SHA-256 {digest[:12]}…) from frame {found['frame']} on")
