"""What the fields of a release hold, in words: for the card and for Croissant."""

from __future__ import annotations

ARRAY_TEXTS = {
    "state": "the state record before the step, from which everything else of the game follows",
    "actions": "the ego's actions",
    "rewards": "the team's reward, unshaped",
    "dones": "whether the step is an episode's last kept one",
    "teammate_actions": "the teammate's actions",
    "expert_actions": "what the final ego would do, greedily; labels for supervised learning",
    "episode_end_state": "the state record after each episode's last kept step",
    "obs": "what the ego sees: 5 x 5 cells, C channels; the loader gives float32 unless asked for uint8",
}
"""What each of `schema.FIELDS` holds."""

ENTRY_TEXTS = {
    "history_id": "number of the history in this release, from 0",
    "task_id": "the task: a layout, a teammate, a seed; see meta/tasks.jsonl",
    "env_idx": "environment stream within the learner's parallel roll-out",
    "T": "steps",
    "obs_shape": "shape of an observation: rows, columns, channels",
    "action_dim": "number of actions",
    "track": "teammate or layout: what the benchmark's test varies",
    "split": "train, test or heldout",
    "layout": "short name of the kitchen",
    "teammate_family": "rl for learned teammates, H1 to H4 for heuristics",
    "teammate_kind": "the algorithm that made the teammate, or the heuristic's name",
    "h5_group": "group of the shard",
    "has_teammate_actions": "whether teammate_actions are there",
    "has_expert_actions": "whether expert_actions are there",
    "h5_row": "row in the group's stacked arrays; null where the group holds this history alone",
    "shard": "file that holds the history",
    "seed": "seed of the learner; -1 where the task was not given",
    "episodes": "episodes that ended",
    "score": "end + (end - start) of the learning curve, by which streams were chosen",
    "return_start": "mean return of the first tenth of the episodes, at least five",
    "return_end": "mean return of the last tenth of the episodes, at least five",
    "return_mean": "mean return of all episodes",
}
"""What each field of `schema.Entry` says."""
