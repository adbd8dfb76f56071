"""`cronos-reproduce status`: a job that has no note yet is not running because its element is."""

from rich.console import Console

from cronos_lerobot.experiments import status
from cronos_lerobot.experiments.slurm import slurm_folder
from cronos_lerobot.experiments.submitted import Submission, write_submissions


def test_a_job_of_a_running_element_that_has_not_begun_waits(tmp_path, monkeypatch):
    """Demonstrations and clone are one element, which runs the one after the other."""
    folder = slurm_folder(tmp_path)
    folder.mkdir(parents=True)
    jobs = {"base/x/demos": "101", "base/x/clone": "101", "runs/later": "102_0"}
    write_submissions(folder, {name: Submission(element, None) for name, element in jobs.items()})
    queue = {"101": ("RUNNING", "None"), "102_0": ("PENDING", "Dependency")}
    monkeypatch.setattr(status, "squeue", lambda: queue)
    console = Console(width=200, record=True)
    console.print(status.make_status_table(tmp_path))
    rows = [line.split() for line in console.export_text().splitlines()[1:]]
    assert ["base/x/clone", "waiting", "101"] in rows
    assert ["runs/later", "pending", "Dependency", "102_0"] in rows
