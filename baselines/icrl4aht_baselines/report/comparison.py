"""Write the page docs/results.md, which compares the stored results of agents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrl4aht_baselines.agents.egos import OTHER_WAYS
from icrl4aht_baselines.plotting import panel_grid
from icrl4aht_baselines.report.results import (
    EPISODE_BLOCKS,
    TEST_LAYOUTS,
    AgentReturns,
    ResultCell,
    mean_over_cells,
    sorted_cells,
)
from icrl4aht_baselines.report.scores import (
    CellScales,
    add_scales,
    block_difference,
    cell_scales,
    cells_with_headroom,
    find_score,
    known_headroom,
    score_difference,
)
from icrl4aht_baselines.report.statistics import MeanInterval, holm_corrected
from icrl4aht_baselines.report.stored_results import StoredResults
from icrl4aht_baselines.report.submission import SUBMITTED_PROTOCOL, AgentFacts
from icrl4aht_baselines.training.seen import overlap_marks
from icrl4aht_data.benchmark.adaptation import published_adaptation_table
from icrl4aht_data.benchmark.best_responses import BestResponse, read_best_responses
from icrl4aht_data.benchmark.facts import ALL_TRACKS, PREFERENCE, TRACKS, layout_track
from icrl4aht_data.benchmark.reference_returns import read_reference_returns
from icrl4aht_data.plotting import add_legend_below, average_in_blocks, axis_limits, save_figure
from icrl4aht_data.reading.arrow_tables import import_pyarrow
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_noun, fill_template, markdown_table

RESULTS_FILES = ("results.md", "results.png", "results.parquet")

_PANELS = 6
_SIGNIFICANT = 0.05
_PRIMARY_TRACK = "teammate"  # N on it is the primary endpoint, see docs/protocol.md


class SecondaryEffect(NamedTuple):
    """Effect with its interval, and its p-value after Holm's correction over all effects that the page tests.

    Attributes:
        effect: the mean and its 95 % interval, which is not corrected.
        p: corrected p-value; NaN if the effect has no interval.
    """

    effect: MeanInterval
    p: float

    def text(self, digits: int, sign: str = "+") -> str:
        """Return mean and interval as text, in bold if the mean is significantly above 0."""
        text = self.effect.text(digits, sign)
        return f"**{text}**" if self.effect.mean > 0 and self.p < _SIGNIFICANT else text


SecondaryEffects = Mapping[tuple[str, ...], SecondaryEffect]
"""All effects that the page tests besides the primary endpoint. Keys: ("N", track, agent), ("difference", track,
agent, other agent) for differences of N, ("cleared", where, agent) for M, and ("swapped", where, agent) for P; `where`
is `PUBLISHED_TRACKS` or `PREFERENCE`."""

PUBLISHED_TRACKS = "published"
"""Name for both published tracks together, over which M and P are averaged."""


def write_comparison(stored: StoredResults, folder: Path) -> list[Path]:
    """Write the page of results, its figure, and the table of results as a Parquet file. Return the paths.

    Raises:
        OptionError: if pyarrow or matplotlib is not installed.
    """
    import_pyarrow()
    folder.mkdir(parents=True, exist_ok=True)
    text, figure, parquet = paths = [folder / name for name in RESULTS_FILES]
    text.write_text(render_comparison(stored), encoding="utf-8")
    plot_comparison(stored, figure)
    with atomic_write(parquet) as partial:
        add_scales(stored.table).round(3).to_parquet(partial, index=False)
    return paths


def render_comparison(stored: StoredResults) -> str:
    """Return the text of docs/results.md. Tables leave out agents of older code, see `AgentFacts.commit`."""
    scales = cell_scales(SUBMITTED_PROTOCOL)
    results = {agent: cells for agent, cells in stored.returns().items() if not stored.agents[agent].commit}
    scored, hidden_dish = cells_with_headroom(scales), cells_with_headroom(scales, PREFERENCE)
    shown = stored.with_other_play_modes(results)
    effects = secondary_effects(stored, results, scales)
    played = [cell for cell in sorted_cells(scales) if cell.kind in ("test", PREFERENCE)]
    flat = [" ".join(cell[:2]) for cell in played if cell not in (*scored, *hidden_dish)]
    one_way = [f"`{agent}`" for agent in results if not any(f"{agent} ({way})" in shown for way in OTHER_WAYS)]
    return fill_template(
        "results.md",
        agents=agents_table(stored, shown, scales, effects),
        one_way=f" Not measured for: {', '.join(one_way)}." if one_way else "",
        differences=describe_differences(effects),
        controls=controls_table(results, scales, effects),
        layouts=layouts_table(results, scales),
        adaptation=published_adaptation_table({name: mean_best_return(name, scales) for name in TEST_LAYOUTS}),
        trainings=describe_training_runs(),
        about="\n".join(_describe_agent(agent, stored.agents[agent]) for agent in results),
        version=read_best_responses().version,
        cells=f"{len(scored)} of {sum(cell.kind == 'test' for cell in scales)} cells",
        scored=", ".join(dict.fromkeys(cell.layout for cell in scored)) or "none",
        without=f". Without headroom: {', '.join(flat)}" if flat else "",
        alpha=f"{_SIGNIFICANT:g}",
        rows=f"{len(stored.table):,}",
    )


def _describe_agent(agent: str, facts: AgentFacts) -> str:
    name = f"[`{agent}`]({facts.link})" if facts.link else f"`{agent}`"
    return f"* {name}: {facts.about.rstrip('.')}."


def _format_interval(value: MeanInterval | None, digits: int = 2, sign: str = "") -> str:
    return value.text(digits, sign) if value else "–"


def secondary_effects(
    stored: StoredResults, results: Mapping[str, AgentReturns], scales: CellScales
) -> dict[tuple[str, ...], SecondaryEffect]:
    """Return all effects that the page tests besides the primary endpoint, see `SecondaryEffects`.

    Agents are compared with the agent that has the next lower N on the track, paired by task and seed.
    """
    found: dict[tuple[str, ...], MeanInterval] = {}
    for track in ALL_TRACKS:
        cells = cells_with_headroom(scales, track)
        scores = {agent: score.total for agent, of in results.items() if (score := find_score(of, cells, scales))}
        if track != _PRIMARY_TRACK:
            found |= {("N", track, agent): total for agent, total in scores.items()}
        for one, other in pairwise(sorted(scores, key=lambda agent: -scores[agent].mean)):
            found["difference", track, one, other] = score_difference(results[one], results[other], cells, scales)
    for control, block in (("cleared", "all"), ("swapped", "last 20")):
        others = stored.returns(control)
        for agent, cells in results.items():
            for where, chosen in _controlled_cells(cells, scales).items():
                difference = block_difference(cells, others.get(agent, {}), chosen, block)
                found |= {(control, where, agent): difference} if difference else {}
    corrected = holm_corrected({key: effect.p for key, effect in found.items()})
    return {key: SecondaryEffect(effect, corrected[key]) for key, effect in found.items()}


def agents_table(
    stored: StoredResults, results: Mapping[str, AgentReturns], scales: CellScales, effects: SecondaryEffects
) -> str:
    """Return table 1, with a row for each agent: training data, labels, budget, and scores on each track.

    An agent has a score on a track only if it played all layouts and families of the track that have headroom. Rows
    of an agent's other play mode, such as "rl2 (greedy)", have only scores.
    """
    body = []
    for agent, cells in results.items():
        facts, marks = stored.agents.get(agent), {name for of in cells.values() for name in of.overlaps}
        texts = [""] * 3
        if facts:
            hours = "" if facts.core_hours is None else f"{facts.core_hours:g} core-hours"
            texts = [facts.data, facts.labels, ", ".join(filter(None, (facts.steps, hours))) or "–"]
        row = [f"`{agent}`{overlap_marks(marks)}{_runs_text(cells)}", *texts]
        for track in ALL_TRACKS:
            score = find_score(cells, cells_with_headroom(scales, track), scales)
            tested = effects.get(("N", track, agent))
            total = tested.text(2, "") if tested else _format_interval(score and score.total)
            row += [total, _format_interval(score and score.middle)]
        body.append(row)
    scored = [f"{name}, {track}" for track in ALL_TRACKS for name in ("N", "IQM")]
    return markdown_table(["model", "data", "labels", "budget", *scored], body)


def _runs_text(cells: AgentReturns) -> str:
    """Return text with the number of an agent's training runs, or an empty string if it was trained once."""
    runs = {
        PREFERENCE if cell.kind == PREFERENCE else PUBLISHED_TRACKS: len(of.trainings) for cell, of in cells.items()
    }
    if {*runs.values()} <= {1}:
        return ""
    if len({*runs.values()}) == 1:
        return f" ({max(runs.values())} runs)"
    texts = [f"{where} {counted_noun(number, 'run')}" for where, number in runs.items()]
    return f" ({', '.join(texts)})"


def _tracks_of(cells: Iterable[ResultCell]) -> list[str]:
    """Return the names of the published tracks that the cells' layouts belong to."""
    return list(dict.fromkeys(layout_track(cell.layout) for cell in cells))


def describe_differences(effects: SecondaryEffects) -> str:
    """Return a list item for each track with the differences of N between agents."""
    lines = []
    for track in ALL_TRACKS:
        compared = {key[2:]: effect for key, effect in effects.items() if key[:2] == ("difference", track)}
        texts = [f"`{one}` - `{other}` {effect.text(2)}" for (one, other), effect in compared.items()]
        lines += [f"* Track `{track}`: {', '.join(texts)}."] if texts else []
    return "\n".join(lines) or "No two models have a score on the same track."


def controls_table(results: Mapping[str, AgentReturns], scales: CellScales, effects: SecondaryEffects) -> str:
    """Return table 2: benefit M of memory, benefit P of the right context, and mean returns in blocks of episodes.

    Means are over the combinations of layout and family that the agent played and that have headroom, or over all that
    it played if none of them has headroom. On the track `preference`, means are over layouts.
    """
    body = []
    for where in (PUBLISHED_TRACKS, PREFERENCE):
        for agent, cells in results.items():
            chosen = _controlled_cells(cells, scales).get(where, [])
            units = grouped(chosen, lambda cell: cell.layout if cell.kind == PREFERENCE else cell).values()
            if not units:
                continue
            tested = (effects.get((control, where, agent)) for control in ("cleared", "swapped"))
            tracks = _tracks_of(chosen)
            played = where if where == PREFERENCE or len(tracks) == len(TRACKS) else tracks[0]
            row = [f"`{agent}`", played, *(effect.text(1) if effect else "–" for effect in tested)]
            for block in EPISODE_BLOCKS:
                found = [[cells[cell].blocks[block] for cell in unit if block in cells[cell].blocks] for unit in units]
                parts = [np.concatenate(of, axis=1) for of in found if of]
                row.append(f"{mean_over_cells(parts):z.1f}" if parts else "–")
            body.append(row)
    return markdown_table(["model", "tracks", "M", "P", *EPISODE_BLOCKS], body, right=len(EPISODE_BLOCKS))


def _controlled_cells(cells: AgentReturns, scales: CellScales) -> dict[str, list[ResultCell]]:
    """Return the cells over which M and P are averaged, by `PUBLISHED_TRACKS` and `PREFERENCE`, if any were played."""
    found = {}
    for where, kind in ((PUBLISHED_TRACKS, "test"), (PREFERENCE, PREFERENCE)):
        known = cells_with_headroom(scales, PREFERENCE if where == PREFERENCE else None)
        found[where] = [cell for cell in known if cell in cells] or [cell for cell in cells if cell.kind == kind]
    return {where: own for where, own in found.items() if own}


def describe_scores(stored: StoredResults, agents: Iterable[str]) -> dict[str, str]:
    """Return agent -> text with its score N on each track and the benefit M of its memory; a dash if missing.

    The text names the number of training runs if the numbers are means over several.
    """
    scales, results, controls, found = cell_scales(SUBMITTED_PROTOCOL), stored.returns(), stored.returns("cleared"), {}
    for agent in agents:
        cells, cleared, texts = results.get(agent, {}), controls.get(agent, {}), []
        for track in ALL_TRACKS:
            score = find_score(cells, cells_with_headroom(scales, track), scales)
            texts.append(f"N {_format_interval(score and score.total)} on track {track}")
        for where, on in ((PUBLISHED_TRACKS, "on tracks teammate and layout"), (PREFERENCE, "on track preference")):
            memory = block_difference(cells, cleared, _controlled_cells(cells, scales).get(where, ()), "all")
            texts.append(f"M {_format_interval(memory, 1, '+')} {on}")
        found[agent] = ", ".join(texts) + _runs_text(cells)
    return found


def mean_best_return(layout: str, scales: CellScales) -> float | None:
    """Return the mean return of the best responses to the teammate families on a layout; None without best responses.

    For a family without a best response, the return of `stay` is used, because the oracle earns at most 1 more than
    `stay` with this family, see `scores.cell_scales`.
    """
    cells = {
        ResultCell(*cell): egos
        for cell, egos in read_reference_returns(SUBMITTED_PROTOCOL).items()
        if cell[0] == layout
    }
    if not cells.keys() & scales.keys():
        return None
    return float(np.mean([scales[cell].best if cell in scales else egos["stay"] for cell, egos in cells.items()]))


def layouts_table(results: Mapping[str, AgentReturns], scales: CellScales) -> str:
    """Return table 3: mean return on each layout, with the score N in parentheses, worst teammate, and regret.

    The first rows show `stay`, the oracle, the best responses, and how far the returns of a best response's training
    runs with equal settings lie apart (highest minus lowest, mean).
    """
    scored, headroom = cells_with_headroom(scales), read_reference_returns(SUBMITTED_PROTOCOL)
    body = []
    for ego in ("stay", "oracle"):
        means = (np.mean([egos[ego] for cell, egos in headroom.items() if cell[0] == name]) for name in TEST_LAYOUTS)
        body.append([f"`{ego}`", *(f"{mean:z.1f}" for mean in means), "", ""])
    bests = [mean_best_return(name, scales) for name in TEST_LAYOUTS]
    body.append(["best response", *("–" if best is None else f"{best:z.1f}" for best in bests), "", ""])
    ranges = training_ranges()
    body.append(
        ["range of runs", *(f"{ranges[name]:z.1f}" if name in ranges else "–" for name in TEST_LAYOUTS), "", ""]
    )
    for agent, cells in results.items():
        texts = []
        for name in TEST_LAYOUTS:
            played = [of.mean for cell, of in cells.items() if cell.layout == name]
            score = find_score(cells, [cell for cell in scored if cell.layout == name], scales)
            text = f"{mean_over_cells(played):z.1f}" if played else "–"
            texts.append(f"{text} ({score.total.mean:z.2f})" if score else text)
        played = [cell for cell in scored if cell in cells]
        score = find_score(cells, played, scales)
        worst = f"{score.worst[1]:z.2f}, {score.worst[0]}" if score else "–"
        # The regret of an agent of one track is not comparable with that of others.
        only = "" if played == scored else f" ({' and '.join(_tracks_of(played))} only)"
        body.append([f"`{agent}`", *texts, worst, f"{score.regret:z.1f}{only}" if score else "–"])
    return markdown_table(["model", *TEST_LAYOUTS, "worst teammate", "regret"], body, right=len(TEST_LAYOUTS) + 2)


def _published_responses() -> list[BestResponse]:
    """Return the best responses to the published test teammates."""
    return [one for one in read_best_responses().behaviours if one.split == "test" and one.layout in TEST_LAYOUTS]


def training_ranges() -> dict[str, float]:
    """Return layout -> mean difference of the highest and lowest return of best responses' training runs.

    The mean is over the test behaviours that have several training runs with equal settings. The runs with the most
    common settings are compared.
    """
    returns = []
    for one in _published_responses():
        alike = max(grouped(one.seeds, lambda run: (run.steps, run.width, run.init)).values(), key=len)
        returns += [(one.layout, [run.mean_return for run in alike])] if len(alike) > 1 else []
    return {
        layout: float(np.mean([max(of) - min(of) for _, of in own]))
        for layout, own in grouped(returns, lambda item: item[0]).items()
    }


def describe_training_runs() -> str:
    """Return sentences on how the best responses were trained, or an empty string if there are none."""
    behaviours = _published_responses()
    trained = [training for one in behaviours for training in one.seeds]
    if not trained:
        return ""
    steps = _format_range([one.steps for one in trained], ",d")
    width, tuned = _format_range([one.width for one in trained], "d"), [one.seed for one in trained if one.init]
    started = (
        f" {len(tuned)} runs, with seed {_format_range(tuned, 'd')}, started from a bundled model; its own training is "
        "not counted."
        if tuned
        else ""
    )
    models = sum(not one.agent.startswith("best response") for one in behaviours)
    runs = _format_range([len(one.seeds) for one in behaviours], "d")
    return (
        f"Each of {len(behaviours)} behaviours of published test teammates has {runs} training "
        f"{'run' if runs == '1' else 'runs'} of {steps} steps with width {width}.{started} For {models} behaviours a "
        "stored model earned more."
    )


def _format_range(values: Sequence[int], form: str) -> str:
    low, high = (format(limit, form) for limit in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def plot_comparison(stored: StoredResults, path: Path) -> None:
    """Plot the agents' returns by episode on a log axis, with dashed lines for cleared memory.

    Each of the first six layouts with headroom in test tasks has a panel. Lines show `stay` and best responses.
    """
    scales, headroom = cell_scales(SUBMITTED_PROTOCOL), read_reference_returns(SUBMITTED_PROTOCOL)
    known = known_headroom(SUBMITTED_PROTOCOL)
    tested = (cell for cell in sorted_cells(known) if known[cell] and cell.kind == "test")
    layouts = list(dict.fromkeys(cell.layout for cell in tested))[:_PANELS]
    figure, grid = panel_grid(layouts, 3, (3.6, 3), "episode")
    shown = [agent for agent in stored.returns() if not stored.agents[agent].commit]
    curves = {
        key: of.sort_values("episode")["return"].to_numpy()
        for key, of in stored.curves.groupby(["agent", "control", "layout"], sort=False)
    }
    for axes, layout in zip(grid, layouts, strict=False):
        for number, agent in enumerate(shown):
            color, marker = f"C{number % 10}", ["", "o", "s", "^"][number // 10 % 4]
            for control, style in (("", "-"), ("cleared", "--")):
                if (curve := curves.get((agent, control, layout))) is not None:
                    label = agent if not control else f"{agent}, memory cleared"
                    episodes, (mean,) = average_in_blocks(curve[None])
                    look = {"color": color, "marker": marker, "markersize": 3, "linewidth": 1.2}
                    axes.plot(episodes, mean, style, label=label, **look)
        stays = [egos["stay"] for cell, egos in headroom.items() if cell[0] == layout]
        axes.axhline(np.mean(stays), color="gray", linestyle=":", label="stay")
        if (best := mean_best_return(layout, scales)) is not None:
            axes.axhline(best, color="black", label="best response")
        axes.set_ylim(*axis_limits(value for line in axes.lines for value in np.ravel(line.get_ydata())))
        axes.set_xscale("log")
        axes.set_xlim(0.9, 110)
        axes.set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    grid[0].set_ylabel("return of an episode", fontsize=8)
    add_legend_below(figure)
    save_figure(figure, path)
