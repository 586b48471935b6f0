"""Commands that record a model's histories, train reference models, and write the page of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.jobs.options import queue_options, read_queue_options

from icrl4aht_baselines.commands import options as shared
from icrl4aht_baselines.training.options import FILTERS, HistoryOptions
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.commands.dataclass_options import OptionValue, TopicCommand, dataclass_options, topic
from icrl4aht_data.commands.options import COUNT, TRACK, Folder, Names, NewFile, examples, overwrite_option
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.layouts_file import read_tasks_and_layouts
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.options import Share, option_hints
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.text import counted_noun


@click.command(
    "collect",
    epilog=examples(
        "icrl4aht-data collect --agent runs/rl2 --root build/noise/lite --out build/agent",
        "icrl4aht-data collect --agent runs/ad --layout demo_wide --histories 2 --out build/agent",
        "icrl4aht-data collect --agent rl2-reference --layout demo_wide --swap 5 --out build/swaps",
    ),
)
@click.option(
    "--agent",
    type=shared.EGO_NAME,
    required=True,
    help="A folder that `train` made, a bundled model such as ad-reference, or a reference ego.",
)
@shared.greedy_option
@shared.root_option
@shared.only_layouts_option
@dataclass_options(HistoryOptions, "filters", exclude={*option_hints(HistoryOptions)} - {*FILTERS})
@click.option("--histories", type=COUNT, default=8, help="Histories with each teammate.")
@click.option("--episodes", type=click.IntRange(min=10), default=60, help="Episodes of each history, of 100 steps.")
@click.option(
    "--noise",
    nargs=2,
    type=OptionValue(Share),
    default=(0.0, 0.0),
    metavar="START END",
    help="Chance of a random action in a history's first and in its last episode.",
)
@click.option(
    "--labeller",
    type=shared.EGO_NAME,
    help="Another agent whose most probable actions become the expert actions, such as rl2-reference, or the script "
    "search for tasks with a hidden dish.",
)
@click.option(
    "--swap",
    type=COUNT,
    metavar="N",
    help="Change the teammate after every N episodes to another one of its kind, layout and split, unannounced.",
    show_default="never",
)
@click.option(
    "--number",
    type=click.IntRange(0, 9),
    default=0,
    help="Number of the collection. Releases with different numbers have different tasks, so they can be combined.",
)
@shared.manifests_option
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the release here.")
@overwrite_option
def collect_command(
    agent: str,
    greedy: bool | None,
    root: Any,
    layouts: tuple[str, ...],
    filters: dict[str, Any],
    histories: int,
    episodes: int,
    noise: tuple[float, float],
    labeller: str | None,
    swap: int | None,
    number: int,
    manifests: tuple[Path, ...],
    out: Path,
    overwrite: bool,
) -> None:
    """Record histories of an agent with a release's teammates.

    Writes a release of source `agent`. Its expert actions are the choices of the agent before noise is added, or those
    of --labeller. Its oracle actions are the scripted oracle's choices; they are left out where the release states that
    the oracle's return is lower than the return at the end of the histories. Histories with validation teammates are
    recorded as well.
    """
    from icrl4aht_generation.profiles.noise_config import NoiseConfig

    from icrl4aht_baselines.agents.egos import find_agent
    from icrl4aht_baselines.online.agent_histories import collect_release, plan_swaps, release_teammates
    from icrl4aht_baselines.training.histories import check_layouts, filter_histories

    start, end = noise
    config = NoiseConfig(histories, episodes, start=(start, start), end=(end, end))
    ego = find_agent(agent, greedy=greedy)
    other = find_agent(labeller, greedy=True) if labeller else None
    names = [get_layout(name).name for name in layouts] or None
    dataset = filter_histories(load_icrl4aht(root, layout=names), filters)
    check_layouts(dataset, names or ())
    tasks = [task for manifest in manifests for task in read_tasks_and_layouts(manifest)]
    teammates = release_teammates(dataset, number, tasks)
    if swap is not None and (alone := len(teammates.tasks) - len(plan_swaps(teammates.tasks, config.episodes, swap))):
        click.echo(f"{counted_noun(alone, 'task')} without another teammate of its kind, split and layout: not swapped")
    with progress_bars(unit="episodes") as show:
        options: Any = {"labeller": other, "swap": swap, "overwrite": overwrite, "progress": show}
        collect_release(ego, teammates, config, out, **options)
    click.echo(f"wrote {out}; `icrl4aht-data show {out}` describes it")


@click.command(
    "reference",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data research reference --name ad-reference",
        "icrl4aht-data research reference --name rl2-reference --track teammate --out runs/reference",
        "icrl4aht-data research reference --name ad-reference --name dpt-reference --seeds 3 --workers 2",
    ),
)
@click.option(
    "--name",
    "names",
    type=Names("reference model", shared.lazy_attribute("icrl4aht_baselines.reference", "REFERENCE_SETTINGS")),
    multiple=True,
    required=True,
    help="Model, such as ad-reference; repeat.",
)
@click.option(
    "--track",
    type=TRACK,
    multiple=True,
    default=tuple(TRACKS),
    help="Only models of this track, and models of all tracks.",
)
@click.option("--seeds", type=COUNT, default=1, help="Training runs of each model, with different seeds.")
@click.option("--evaluate/--no-evaluate", "evaluates", default=True, help="Evaluate on validation and test tasks.")
@click.option(
    "--bundle-as",
    "bundle",
    metavar="NAME",
    help="Also add the model to the package's bundled models under this name; see `models`.",
)
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/reference", help="Write everything here.")
@topic("Machines", queue_options)
def reference_command(
    names: tuple[str, ...],
    track: tuple[str, ...],
    seeds: int,
    evaluates: bool,
    bundle: str | None,
    out: Path,
    queue: dict[str, Any],
) -> None:
    """Make reference models, and the data that they are trained on.

    Generates a release if the model needs one, trains one model for each track or for all tracks, and evaluates it. The
    same command resumes a stopped run. rl2-reference learns by playing with training teammates. rl2-adapting starts
    from it and plays tasks with a hidden dish. dpt-reference learns from `agent` histories of the bundled release, with
    `expert` labels, and ad-reference from these and from `search` histories of profile `teach`, drawn equally often.
    """
    options = read_queue_options(queue)  # sets environment variables, which JAX reads at its first use
    from icrl4aht_generation.jobs.queue import run_jobs
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from rich.console import Console

    from icrl4aht_baselines.agents.bundled import EVERY_TRACK, bundle_run, check_bundle_name
    from icrl4aht_baselines.reference import REFERENCE_SETTINGS, ReferenceJob, write_bundled_card

    if bundle:
        try:
            check_bundle_name(bundle)
        except OptionError as error:
            raise click.UsageError(f"--bundle-as: {error}") from error
        if len(names) != 1 or {*track} != set(TRACKS) or not evaluates or seeds != 1:
            raise click.UsageError(
                "--bundle-as: expected one --name, all tracks, one seed and an evaluation, because the card states its "
                "results; leave out --track, --seeds and --no-evaluate"
            )
    out = out.resolve()  # workers on a cluster have other working directories
    threads = 1 if options.workers or options.executor == "ray" else None  # a single job may use all cores
    jobs = [
        ReferenceJob(name, of_track, seed, out, threads)
        for seed in range(seeds)
        for name in dict.fromkeys(names)
        for of_track in REFERENCE_SETTINGS[name].tracks
        if of_track in (*track, EVERY_TRACK)
    ]
    if not jobs:
        raise click.UsageError(
            f"--track {track[0]}: no model of this track exists for {' and '.join(names)}; leave out --track"
        )
    if threads:  # as many threads as in workers: jobs resume only with an equal number
        limit_xla_threads(threads)
    run_jobs(jobs, out, Console(soft_wrap=True), options)
    if evaluates:
        with progress_bars() as show:
            for job in jobs:
                job.evaluate(show)
    for job in jobs:
        click.echo(f"{job.label}: {job.folder}")
    if bundle:
        for job in jobs:
            click.echo(f"bundled: {bundle_run(job.run_folder, bundle, job.track, role=job.reference.role)}")
        click.echo(f"card: {write_bundled_card(bundle, jobs)}")


def _print_schema(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    from icrl4aht_baselines.report import submission

    if wanted:
        click.echo(submission.submission_schema())
        context.exit()


@click.command(
    "submit",
    epilog=examples(
        "icrl4aht-data submit runs/results --about 'AD, own encoder' --data noise --labels oracle --out mine.json"
    ),
)
@click.argument("folders", nargs=-1, required=True, type=Folder(), metavar="FOLDER...")
@click.option("--about", required=True, help="One sentence on how the agent was made.")
@click.option("--data", required=True, help="Training data of the agent in a few words; none if it was not trained.")
@click.option("--labels", required=True, help="Training targets in a few words; none if there are none.")
@click.option("--steps", default="", help="Length of the training, such as '4,000 updates'.")
@click.option("--core-hours", type=click.FloatRange(min=0), help="Core-hours of the training and of making its data.")
@click.option("--link", default="", help="Address of a paper or repository.")
@click.option("--name", default="", help="Name of the agent in tables.", show_default="that in the results")
@click.option("--update", is_flag=True, help="Replace the agent's results that are already on the page.")
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Only print the JSON schema of the file.",
)
@click.option("--out", type=NewFile(".json"), metavar="FILE", required=True, help="Write this file.")
@overwrite_option
def submit_command(
    folders: tuple[Path, ...], name: str, update: bool, out: Path, overwrite: bool, **facts: Any
) -> None:
    """Make a file of results for the page that `results` writes.

    Each FOLDER must be written by `evaluate` under the protocol `seeded` with the seeds 0, 1 and 2. Together the
    folders must hold all test tasks of at least one track, and their results must state the agent's training data.
    Give several folders if tracks or training runs were evaluated separately. Results of `evaluate --controls` are
    included. Results with a non-default choice of actions, such as `evaluate --sampled`, get separate rows. A pull
    request that adds the file puts the agent on the page; `icrl4aht-data results FILE` shows a preview.
    """
    from icrl4aht_baselines.report import stored_results, submission

    check_output(out, overwrite)
    found = submission.make_submission(folders, submission.AgentFacts(**facts), name, update)
    stored = stored_results.read_stored(stored_results.results_file())
    added = stored_results.add_submission(stored, found, ", ".join(map(str, folders)))  # raises errors
    submission.write_submission(out, found)
    for line in stored_results.describe_removed(stored, added, found.agent):
        click.echo(f"the update removes stored results of {found.agent}: {line}")
    click.echo(f"wrote {out}: {found.agent}, {' and '.join(found.tracks)}; `icrl4aht-data results {out}` shows it")


@click.command(
    "results",
    epilog=examples(
        "icrl4aht-data results --out build/results",
        "icrl4aht-data results mine.json --out build/results",
    ),
)
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[FILE]...")
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the page here.")
@click.option("--store", is_flag=True, help="Also add the results to the package's stored results.")
@overwrite_option
def results_command(files: tuple[Path, ...], out: Path, store: bool, overwrite: bool) -> None:
    """Compare models on the benchmark's tasks.

    Compares the package's stored results with the results in each FILE that `submit` made. Writes a page with tables
    and a figure (results.md and results.png), and all numbers (results.parquet). No two agents may have the same name.
    """
    from icrl4aht_baselines.report import comparison, stored_results
    from icrl4aht_baselines.report.submission import read_submission

    check_output(out, overwrite, comparison.RESULTS_FILES)
    stored = stored_results.read_stored(stored_results.results_file())
    for path in files:
        found = read_submission(path)
        stored = stored_results.add_submission(stored, found, str(path))
    for path in comparison.write_comparison(stored, out):
        click.echo(f"wrote {path}")
    if store:  # after the page, so that nothing is stored if the page cannot be written
        stored_results.write_stored(stored_results.results_file(), stored)


@click.command("models")
def models_command() -> None:
    """List the bundled models.

    `evaluate`, `watch` and `collect` accept these names as agents. The first line of each model states its purpose, its
    score N on each track, the benefit M of its memory, and its date. A line for each training run states method,
    parameters, context, training layouts and sources. By default these models sample their actions.
    """
    from icrl4aht_baselines.agents.bundled import bundled_models, describe_model
    from icrl4aht_baselines.report.comparison import describe_scores
    from icrl4aht_baselines.report.stored_results import read_stored, results_file

    models = bundled_models()
    scores = describe_scores(read_stored(results_file()), models)
    for model in models.values():
        click.echo(f"{model.name}: {model.role}; {scores[model.name]}; of {model.date}")
        for line in describe_model(model):
            click.echo(f"  {line}")
