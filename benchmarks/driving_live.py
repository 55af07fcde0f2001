"""How long Blender is held up by a live source, and whether anything grows.

    python benchmarks/driving_live.py [--seconds 600] [--rate 60] [--malformed 10000] [--realtime]

Drives the demo's head in the bpy module by Live Link Face packets over loopback, with the malformed packets spread
evenly between them. Without --realtime, packets follow each other without waiting. Prints the time of the ticks by the
clock and in processor time, how often ticks waited (for a file, a lock, another thread), the time of evaluating the
head after them, and the memory in use. Where ticks do not wait, what the clock shows beyond processor time was taken by
other programs, or from a virtual machine by its host. Linux.
"""

import argparse
import importlib.util
import resource
import socket
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from driving.live import wire  # noqa: E402
from driving.live.test_decoders import malformed  # noqa: E402

from stga_addon.development.demo.head import synthetic_flame, write_flame  # noqa: E402
from stga_addon.scene.arrays import evaluated_vertices  # noqa: E402

REPORTS = 10


def register_extension() -> None:
    """Register the checkout as an extension."""
    spec = importlib.util.spec_from_file_location(
        "stga_checkout", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules["stga_checkout"] = package
    spec.loader.exec_module(package)
    package.register()


def set_up(folder: Path) -> int:
    """The demo's head, and the port that it is driven on."""
    write_flame(synthetic_flame(0), folder / "flame.npz")
    np.savez(folder / "own.npz", expr=np.random.default_rng(0).normal(0, 0.3, (5, 10)))
    bpy.ops.stga.import_motion(filepath=str(folder / "own.npz"), flame=str(folder / "flame.npz"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    bpy.context.scene.stga.drive.port = port
    bpy.ops.stga.drive_live()
    return port


def usage() -> tuple[float, int]:
    """This thread's processor time in seconds, and how often it has waited for anything but a free processor."""
    return time.thread_time(), resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--rate", type=int, default=60)
    parser.add_argument("--malformed", type=int, default=10_000)
    parser.add_argument("--realtime", action="store_true")
    options = parser.parse_args()
    register_extension()
    session_module = sys.modules["stga_checkout.operators.live_session"]
    with tempfile.TemporaryDirectory() as folder:
        port = set_up(Path(folder))
    head = bpy.context.scene.stga.head
    session = session_module.session()
    sender, rng = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), np.random.default_rng(0)
    rows = [wire.mixed(seed) for seed in range(50)]
    count = options.seconds * options.rate
    ticks, cpu, evaluations = np.zeros(count), np.zeros(count), np.zeros(count)
    bad = waits = waits_before = 0
    begin = time.monotonic()
    print(
        "| packets | memory MB | median tick ms | longest tick ms | longest in processor time | waits |\n"
        "|---|---|---|---|---|---|"
    )
    for number in range(count):
        sender.sendto(wire.live_link_face(rows[number % 50], number), ("127.0.0.1", port))
        while bad < options.malformed * (number + 1) // count:
            sender.sendto(malformed(rng), ("127.0.0.1", port))
            bad += 1
        before, at = usage(), time.perf_counter()
        session.tick()
        ticks[number], after = time.perf_counter() - at, usage()
        cpu[number], waits = after[0] - before[0], waits + after[1] - before[1]
        at = time.perf_counter()
        bpy.context.view_layer.update()
        evaluated_vertices(head)
        evaluations[number] = time.perf_counter() - at
        if options.realtime:
            time.sleep(max(0.0, begin + (number + 1) / options.rate - time.monotonic()))
        if (number + 1) % (count // REPORTS) == 0:
            part = slice(number + 1 - count // REPORTS, number + 1)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"| {number + 1} | {memory:.1f} | {1e3 * np.median(ticks[part]):.2f} | {1e3 * ticks[part].max():.1f} "
                f"| {1e3 * cpu[part].max():.1f} | {waits - waits_before} |",
                flush=True,
            )
            waits_before = waits
    stream, health = session.stream, session.stream.health(time.monotonic())
    print(
        f"\nlast packet shown: {stream.latest is not None}; lost {health.lost}, late {health.late}, "
        f"foreign {health.foreign}"
    )
    print(
        f"evaluating the head: median {1e3 * np.median(evaluations):.2f} ms, longest {1e3 * evaluations.max():.1f} ms"
    )


if __name__ == "__main__":
    main()
