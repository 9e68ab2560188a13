"""Compares what MLflow stored of a run with the run's own files, and looks for the offline run of Weights & Biases."""

import os
import sys
from pathlib import Path

import shoal

os.environ["MLFLOW_ALLOW_FILE_STORE"] = "true"
import mlflow  # noqa: E402

run = shoal.Run(sys.argv[1])
client = mlflow.MlflowClient(tracking_uri=f"file://{Path.cwd()}/mlruns")
experiment = client.get_experiment_by_name("shoal")
[tracked] = client.search_runs([experiment.experiment_id])
assert tracked.info.status == "KILLED", tracked.info.status
assert tracked.data.params["ddpg.gamma"] == "0.99" and tracked.data.params["run.seed"] == "1", tracked.data.params
for metric, column, table in [
    ("evaluation/return_mean", "return_mean", run.evaluations),
    ("learner/critic_loss", "critic_loss", run.learner),
    ("episode/return", "return", run.episodes),
]:
    history = sorted((one.step, one.value) for one in client.get_metric_history(tracked.info.run_id, metric))
    expected = sorted(zip(table["env_steps"].tolist(), table[column].tolist()))
    expected = [one for one in expected if one[1] == one[1]]
    assert history == expected and history, (metric, len(history), len(expected))
files = {file.path for file in client.list_artifacts(tracked.info.run_id)}
assert {"config.toml", "used.toml"} <= files, files
assert list(run.path.glob("wandb/offline-run-*/run-*.wandb")), list(run.path.iterdir())
