"""Compares the actions of a run's policies with those in `expected.json`."""

import json
import sys

import numpy as np
import shoal

run = shoal.Run(sys.argv[1])
with open("expected.json") as file:
    expected = json.load(file)
for name, (observations, actions) in expected.items():
    policy = run.policy(name)
    observations = np.array(observations, dtype=np.float32)
    found = policy(observations)
    assert len(found) == len(actions) > 50, (name, len(found))
    if policy.algorithm in ("q-learning", "sarsa"):
        assert np.array_equal(found, np.array(actions)), name
    elif found.dtype == np.int64:
        # Actions with almost the same score may change places with another order of additions.
        scores = np.sort(policy.scores(observations), axis=1)
        clear = scores[:, -1] - scores[:, -2] > 1e-5
        assert (found == np.array(actions).reshape(found.shape))[clear].all() and clear.mean() > 0.5, name
    else:
        np.testing.assert_allclose(found, np.array(actions).reshape(found.shape), rtol=1e-4, atol=1e-5)
    one = policy(observations[0])
    assert np.array_equal(one, found[0]) or np.allclose(one, found[0], rtol=1e-5), name
print(f"{run.path.name}: the policies agree")
