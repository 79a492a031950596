"""What a gRPC client, a model and a recorder see on the host of a mirror: the frames of the owner."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from shmio.segment import Quality, Segment
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port
from tests.faults.far_consumers import FOLLOWER, FrameWatcher, GrpcClient, check_client, check_model, values

COUNTER = """
from shmio.simulation import Model, Output


class Counter(Model):
    value = Output("REAL")

    def step(self, time_s, dt_s):
        self.value += 1
"""
NEAR = """
[instance]
name = "{instance}n"
[[source]]
name = "cell"
connector = "simulation"
model = "counter:Counter"
period_ms = 20
[recorder]
[fabric]
server = "embedded"
listen = "{nats}"
cell = "plant1.line3.near"
"""
FAR = """
[instance]
name = "{instance}f"
[[source]]
name = "cell"
connector = "fabric"
cell = "plant1.line3.near"
[[source]]
name = "follower"
connector = "simulation"
model = "follower:Follower"
period_ms = 5
connections = {{ value = "cell/value" }}
[recorder]
sources = ["cell"]
[grpc]
listen = ["unix:grpc.sock"]
[fabric]
server = "nats://{nats}"
"""
FRAMES = 60


def test_consumers_of_a_mirror_see_every_frame(tmp_path: Path, instance: str) -> None:
    with reserved_port() as nats, ExitStack() as stack:
        cells = []
        for mark, text in (("n", NEAR), ("f", FAR)):
            folder = tmp_path / mark
            folder.mkdir()
            (folder / "counter.py").write_text(COUNTER)
            (folder / "follower.py").write_text(FOLLOWER)
            (folder / "supervisor.toml").write_text(text.format(instance=instance, nats=nats))
            cells.append(Cell(folder, f"{instance}{mark}", nats))
            stack.callback(cells[-1].supervisor, "down")
            cells[-1].up()
        near, far = cells
        with Segment.open(near.instance) as there, Segment.open(far.instance) as here:
            owner, mirror = FrameWatcher(there), FrameWatcher(here)
            until(lambda: any(one.quality is Quality.GOOD for one in mirror.frames), "the mirror is good")
            client, model = GrpcClient(f"unix:{far.folder / 'grpc.sock'}", "cell"), FrameWatcher(here, "follower")
            until(lambda: len(client.updates) >= FRAMES, "the client has received frames")
            updates, followed, mirrored, frames = client.stop(), model.stop(), mirror.stop(), owner.stop()
            assert check_client(updates, frames) >= FRAMES - 1
            cycles = [one.cycle for one in mirrored if one.quality is Quality.GOOD]
            assert cycles == [one.cycle for one in frames if cycles[0] <= one.cycle <= cycles[-1]]
            seen, _ = check_model(values(model.block, "seen", followed)[1:], values(owner.block, "value", frames))
            assert seen > FRAMES // 3, "the model follows"
        far.down()
        near.down()
        files = [str(next((cell.folder / "dumps").glob("*.mem"))) for cell in cells]
        near.output("shmio-dump", "diff", *files, "--ignore", "times,ends")
