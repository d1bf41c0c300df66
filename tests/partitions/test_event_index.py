"""Events in two partitions: the index finds each of them, and names the partition that had it first."""

import numpy as np

from optloc.partitions.event_index import EventIndex, event_hashes


def test_hashes_depend_on_epoch_and_target():
    one = event_hashes(["1", "2", "1"], ["a", "a", "b"])
    assert len(one) == 3
    assert len(event_hashes(["1", "1"], ["a", "a"])) == 1
    assert len(np.intersect1d(one, event_hashes(["1"], ["a"]))) == 1
    assert len(event_hashes([], [])) == 0


def test_the_index_finds_what_a_set_finds():
    rng = np.random.default_rng(0)
    index, sets = EventIndex(), []
    for number in range(60):
        labels = {str(i) for i in rng.integers(0, 100_000, rng.integers(0, 200))}
        expected = [f"part {i}" for i, other in enumerate(sets) if other & labels]
        # An event of several earlier partitions is found in at least one of them.
        found = index.add(f"part {number}", event_hashes(sorted(labels), ["t"] * len(labels)))
        assert set(found) <= set(expected)
        assert bool(found) == bool(expected)
        sets.append(labels)
