"""Test forking a process while a thread of the parent prepares a batch."""

from __future__ import annotations

import os

import pytest

from tests.helpers.commands import run_python

FORK = """
import os
import signal
import sys
import threading

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.reading import shard

parent, decode = os.getpid(), shard.decode_chunk
decoding, forked = threading.Event(), threading.Event()


def decode_chunk(*arguments):
    if os.getpid() == parent:
        decoding.set()
        forked.wait(60)
    return decode(*arguments)


shard.decode_chunk = decode_chunk
for cache in sys.argv[2:]:
    decoding.clear()
    forked.clear()
    dataset = load_icrl4aht(sys.argv[1], layout="demo_wide", cache=cache, threads=2)
    sampler = dataset.ad(batch_size=4, length=25)
    batches = sampler.batches()
    thread = threading.Thread(target=lambda: next(batches))
    thread.start()
    assert decoding.wait(30)
    child = os.fork()
    if not child:
        signal.alarm(30)
        first = sampler[0]
        try:
            next(batches)
        except OptionError as error:
            assert f"belongs to process {parent}" in str(error)
            os._exit(0 if (first.obs == sampler.batches(stop=1).__next__().obs).all() else 3)
        os._exit(4)
    forked.set()
    status = os.waitpid(child, 0)[1]
    thread.join()
    batches.close()
    print(cache, os.waitstatus_to_exitcode(status))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_forked_child_can_make_batches(lite, tmp_path):
    """Regression: the child hung on locks of a thread that existed only in the parent."""
    script = tmp_path / "fork.py"
    script.write_text(FORK)
    # Python 3.12 and later warn when a process with threads forks.
    arguments = ["-W", "error", "-W", "ignore::DeprecationWarning", script, lite[0], "ram", "mmap", "stream"]
    printed = run_python(*arguments, ICRL4AHT_CACHE_DIR=str(tmp_path / "cache"))
    assert printed.splitlines() == ["ram 0", "mmap 0", "stream 0"]
