"""Example of a user's script with Grain, PyTorch and JAX; `test_shown.py` runs it, and `make check` type-checks it."""

# pyright: reportUnnecessaryTypeIgnoreComment=error

from typing import TYPE_CHECKING

import grain
import jax
import jax.numpy as jnp
import numpy as np
import torch
import torch.nn.functional as F

from icrl4aht_data import ADBatch, Dataset, DPTBatch, Episode, History, load_icrl4aht
from icrl4aht_data.interop import torch_loader

ds: Dataset = load_icrl4aht(split="train", layout="demo_wide", obs="uint8")
good = ds.filter(lambda entry: entry.return_end > 30).sort("return_end", reverse=True)
train, validation = good.split(validation=0.1, seed=0, by="teammate")
history: History = train[0]
agree: float = float((history.actions == history.expert_actions).mean())
first: np.ndarray = history.actions[:10]
curve: np.ndarray = history.returns()
last: Episode = history.episodes[-1]
print(agree, first.dtype, curve.max(), last.actions.shape, last.total_return, len(history.episodes[:3]))
print(history["rewards"].sum(), [episode.rewards.sum() for episode in ds.sample_episodes(3, seed=0)])

sampler = train.ad(batch_size=8, length=50, seed=0)
batch: ADBatch[np.ndarray] = sampler[np.int64(0)]
print(batch, batch.obs.astype(np.float32).mean(), batch.is_first.sum())
if TYPE_CHECKING:  # the type checker must report an error: NumPy arrays have no `at`
    print(batch.obs.at)  # pyright: ignore[reportAttributeAccessIssue]

for device_batch in sampler.batches(stop=2, device=jax.devices()[0]):
    logits: jax.Array = jnp.zeros((*device_batch.prev_actions.shape, 6))
    print(device_batch.obs.at[0].set(0).shape, jax.nn.log_softmax(logits)[device_batch.attention_mask].shape)
for host_batch in sampler.batches(stop=2):
    print(host_batch.obs.flags.c_contiguous)

for grain_batch in grain.MapDataset.source(sampler).to_iter_dataset():
    print(grain_batch.target_actions.shape)
    break

for tensors in torch_loader(sampler, stop=2):
    scores = torch.zeros(8, 6, 50)
    print(F.cross_entropy(scores, tensors.target_actions).item(), tensors.is_first.sum())

queries = train.dpt(batch_size=4, context=20, seed=0)
query: DPTBatch[np.ndarray] = queries[0]
print(query.query_target.sum(), train.obs_shape, train.layouts[0].name)
frame = ds.to_pandas()
print(frame.groupby("layout", observed=True).size())
picture = history.plot()
assert picture.figure is not None
picture.figure.set_size_inches(4, 3)
history.animate(0).save("episode.gif")
