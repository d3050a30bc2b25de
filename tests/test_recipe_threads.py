"""A run takes no more threads than it gets cores for."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import pytest
import torch
from recipe_runs import ROOT, recipe_module

pytest.importorskip("tqdm")
pytest.importorskip("tyro")

SPIN = """
import os, sys, threading, time
sys.path.insert(0, "recipes")
import torch, _threads
torch.set_num_threads(1)
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
block = torch.rand(400, 400)
threads = [threading.Thread(target=lambda: [block @ block for _ in range(60)]) for _ in range(2)]
start, before = time.perf_counter(), _threads.waited()
for thread in threads: thread.start()
time.sleep(0.2)
print((_threads.waited() - before) / (time.perf_counter() - start))
for thread in threads: thread.join()
"""


@pytest.fixture
def module() -> ModuleType:
    return recipe_module("_threads")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
def test_time_that_threads_wait_for_a_core_is_counted(module: ModuleType) -> None:
    """Threads of one process on one core wait for each other all the time that one runs."""
    if not list(module.TASKS.glob("*/schedstat")):
        pytest.skip("this system does not count how long threads wait")
    done = subprocess.run([sys.executable, "-c", SPIN], cwd=ROOT, capture_output=True, text=True, check=True)
    assert float(done.stdout) > 0.4


@pytest.mark.parametrize(
    ("stay", "waiting", "left"),
    [
        (False, [0.1], 4),
        (False, [1.1], 3),
        (False, [1.6], 2),
        (False, [9.0], 1),
        (False, [1.0, 1.0, 0.2], 2),
        (True, [3.0], 4),
    ],
)
def test_threads_without_cores_are_taken_away(
    module: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    stay: bool,
    waiting: list[float],
    left: int,
) -> None:
    """Of four, by the share of time that they waited in a window; what waits a quarter of the time is let pass."""
    clock, total, number = [0.0], [0.0], [4]
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(module, "waited", lambda: total[0])
    monkeypatch.setattr(torch, "get_num_threads", lambda: number[0])
    monkeypatch.setattr(torch, "set_num_threads", lambda new: number.__setitem__(0, new))
    threads = module.Threads(stay=stay, window=5.0)
    for share in waiting:
        for _ in range(3):  # steps of two seconds: the third is looked back from
            clock[0] += 2
            total[0] += 2 * share
            threads.look()
    assert number[0] == left
    said = capsys.readouterr().err
    assert ("going on with" in said) == (left < 4)
    assert f"going on with {left} of" in said or left == 4
    assert said.count("--threads 4 keeps all") == said.count("going on with")


def test_threads_come_back_when_cores_are_idle(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As many as cores are idle, half a minute after they were taken away, and later each time."""
    clock, total, free, number = [0.0], [0.0], [0.0], [4]
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(module, "waited", lambda: total[0])
    monkeypatch.setattr(module, "idle", lambda: free[0])
    monkeypatch.setattr(torch, "get_num_threads", lambda: number[0])
    monkeypatch.setattr(torch, "set_num_threads", lambda new: number.__setitem__(0, new))
    threads = module.Threads(stay=False, window=5.0, patience=30.0)

    def after(seconds: int, *, missing: float = 0.0, idle: float = 0.0) -> int:
        for _ in range(seconds):
            clock[0], total[0], free[0] = clock[0] + 1, total[0] + missing, free[0] + idle
            threads.look()
        return number[0]

    assert after(40, idle=2.0) == 4 and capsys.readouterr().err == ""  # none to give back
    assert after(5, missing=3.0) == 1
    assert after(40, idle=0.6) == 1
    assert after(5, idle=1.9) == 3
    assert "cores are idle again: going on with 3 of 4 threads" in capsys.readouterr().err
    assert after(55, idle=3.0) == 3
    assert after(5, idle=3.0) == 4
    assert after(5, missing=1.0, idle=3.0) == 3
    assert after(115, idle=3.0) == 3
    assert after(5, idle=3.0) == 4


def test_time_that_cores_are_idle_is_counted(module: ModuleType) -> None:
    if not module.STAT.exists() or not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system does not count how long cores are idle")
    cores = os.sched_getaffinity(0)
    try:
        every, start = module.idle(), time.perf_counter()
        os.sched_setaffinity(0, {min(cores)})
        one = module.idle()
        while time.perf_counter() - start < 0.3:  # takes the core
            pass
        assert module.idle() - one < 0.15
    finally:
        os.sched_setaffinity(0, cores)
    assert (one < every) == (len(cores) > 1)


@pytest.mark.parametrize(("threads", "device", "watched"), [(0, "cpu", 3), (2, "cpu", 1), (0, "cuda", 1)])
def test_threads_are_watched_where_they_compute_and_were_not_asked_for(
    monkeypatch: pytest.MonkeyPatch, threads: int, device: str, watched: int
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    fabric, cfg = SimpleNamespace(device=torch.device(device)), SimpleNamespace(threads=threads)
    trainer = recipe_module("_step").Trainer(fabric, None, None, cfg, None, 1)
    assert trainer.threads.number == watched


def test_threads_that_were_asked_for_outlast_the_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The launcher of several processes gives each its share of the cores."""
    fabric = pytest.importorskip("lightning_fabric").Fabric
    before = torch.get_num_threads()
    monkeypatch.setattr(fabric, "launch", lambda self: torch.set_num_threads(3))
    settings = recipe_module("_settings").Settings(accelerator="cpu", precision="32-true", threads=2)
    try:
        recipe_module("_fabric").connect(settings)
        assert torch.get_num_threads() == 2
        recipe_module("_fabric").connect(replace(settings, threads=0))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_threads_that_were_asked_for_time_the_precisions(monkeypatch: pytest.MonkeyPatch) -> None:
    module, before, seen = recipe_module("_fabric"), torch.get_num_threads(), []
    pytest.importorskip("lightning_fabric")
    monkeypatch.setattr(module, "pick_precision", lambda _: seen.append(torch.get_num_threads()) or "32-true")
    try:
        module.connect(recipe_module("_settings").Settings(accelerator="cpu", precision="auto", threads=2))
    finally:
        torch.set_num_threads(before)
    assert seen == [2]


@pytest.mark.parametrize(("fast", "slow"), [(0.05, 1.0), (2.0, 40.0), (0.05, 0.05)])
def test_steps_are_counted_with_the_threads_of_the_run(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch, fast: float, slow: float
) -> None:
    """Two threads on one core are slow until one is taken away, which is seen after five seconds of steps or later."""
    loop, now = recipe_module("_step"), [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0])
    for part in (module, loop):
        monkeypatch.setattr(part, "time", clock)
    monkeypatch.setattr(module, "waited", lambda: now[0] if slow > fast else 0.0)  # one thread waits all the time
    monkeypatch.setattr(module, "idle", lambda: 0.0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)
    nothing = SimpleNamespace(state_dict=dict, load_state_dict=lambda state: None)
    fabric = SimpleNamespace(device=torch.device("cpu"), broadcast=lambda value: value)
    cfg = SimpleNamespace(threads=0, steps=None, minutes=10.0)
    trainer = loop.Trainer(fabric, nothing, nothing, cfg, None, 0)

    def update(batch: torch.Tensor, s: int) -> None:
        now[0] += fast if trainer.threads.number == 1 or slow == fast else slow
        trainer.threads.look()

    monkeypatch.setattr(trainer, "update", update)
    steps = loop.count_steps(trainer, [torch.zeros(1)] * 5)
    assert steps == round(600 / fast) and trainer.threads.number == (1 if slow > fast else 2)
