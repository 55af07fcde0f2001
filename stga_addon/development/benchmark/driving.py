"""How well ARKit's shapes drive FLAME heads: distances, leaks of identity, and the way back.

    python -m stga_addon.development.benchmark.driving DATA [--poses 1000] [--components 50]

DATA is the folder of `flame_open/flame2023_open_basis.npz`. FLAME's expressions are not published
openly, so the heads have generated ones (tests/driving/heads.py). Prints, for three identities with
a third of the poses each: mean distance at the face points of the map's poses from ICT-FaceKit's
shapes on that head, beside that of a fit of expressions and jaw to each pose alone; the mean
distance from a head's true poses, and from those by its own coefficients, when it is driven by the
parameters of another person whose face leaks into the expressions, in several ways; the largest
error of each weight after parameters and back; and per shape how much of it the head can do.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from ...flame.forward import RIGID_SIZE

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests"))

from driving.heads import generated_flame, random_poses

from ...driving.head_map import HeadMap, head_map
from ...driving.inverse import arkit_weights
from ...driving.open_motion import exchanged_neutral, quiet_neutral
from ...driving.performance import ARKIT_SHAPES, Performance
from ...driving.shapes import effective_weights, face_shapes
from ...flame.forward import FlameFrame
from ...flame.model import JOINTS, FlameModel
from ...flame.sequence import FlameSequence, with_identity
from ...tracking.posed_points import PosedPoints

IDENTITIES = 3
"""Random heads that are driven."""
FREE_STEPS = 3
"""Gauss–Newton steps of the free fit."""
SINGULAR = 1e-12
"""Ridge of the free fit, which only keeps its equations solvable."""
LEAK_RIDGE_M = 1e-4
"""Ridge of the leak's least squares, in meters."""
QUIET_FRAMES = 100
"""Frames of nearly neutral poses before the measured ones."""
JAW = 3 * JOINTS.index("jaw")


class Head:
    """One identity of a model, its map, and its face points."""

    def __init__(self, model: FlameModel, seed: int) -> None:
        shape = np.random.default_rng(seed).normal(0, 1.0, model.n_identity)
        self.sequence = FlameSequence(model, shape, None, (), dict[int, FlameFrame]().__getitem__)
        started = perf_counter()
        self.map: HeadMap = head_map(self.sequence, f"identity {seed}")
        self.seconds = perf_counter() - started
        self.posed = PosedPoints(with_identity(self.sequence).model, self.map.points)
        self.count = model.n_expression
        self.rest = self.points(np.zeros(self.count + 3))

    def rigid(self, jaw: np.ndarray) -> np.ndarray:
        rigid = np.zeros(RIGID_SIZE)
        rigid[JAW : JAW + 3] = jaw
        return rigid

    def points(self, values: np.ndarray) -> np.ndarray:
        """(N, 3) of expressions and jaw (E + 3,)."""
        return self.posed.positions(
            values[: self.count], self.rigid(values[self.count : self.count + 3])
        )

    def true_points(self, weights: np.ndarray) -> np.ndarray:
        """(N, 3) where ICT-FaceKit's shapes put this head's face points."""
        return np.asarray(self.rest + np.tensordot(effective_weights(weights), self.map.targets, 1))

    def free_fit(self, wanted: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Expressions and jaw by Gauss-Newton, without a map."""
        values = start[: self.count + 3].copy()
        columns = [*range(self.count), *range(self.count + JAW, self.count + JAW + 3)]
        for _ in range(FREE_STEPS):
            at, slopes = self.posed.linearized(
                values[: self.count], self.rigid(values[self.count :])
            )
            matrix = slopes[..., columns].reshape(-1, len(columns))
            normal = matrix.T @ matrix
            normal[np.diag_indices(len(normal))] += SINGULAR
            values += np.linalg.solve(normal, matrix.T @ (wanted - at).ravel())
        return values


def mean_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Millimeters."""
    return 1000 * float(np.linalg.norm(first - second, axis=1).mean())


def combinations(heads: list[Head], poses: int) -> None:
    print("## Combinations\n")
    print("| identity | motion mm | map mm | free fit mm | map / free fit | max coefficient |")
    print("|---|---|---|---|---|---|")
    for number, head in enumerate(heads):
        weights = random_poses(poses // len(heads), np.random.default_rng(100 + number))
        found = head.map.parameters(weights)
        rows = []
        for row, values in zip(weights, found, strict=True):
            wanted = head.true_points(row)
            free = head.points(head.free_fit(wanted, values))
            rows.append([mean_distance(p, wanted) for p in (head.rest, head.points(values), free)])
        motion, missed, best = np.mean(rows, axis=0)
        largest = np.abs(found[:, : head.count]).max()
        figures = f"{motion:.3f} | {missed:.3f} | {best:.3f} | {missed / best:.3f} | {largest:.1f}"
        print(f"| {number} | {figures} |", flush=True)


def leaks(driver: Head, driven: Head, poses: int) -> None:
    """Print how well one head takes over another's tracked motion, in several ways.

    Mean distances in mm of the driven head's face points from where ICT-FaceKit's shapes put them,
    and from where its own coefficients do; "less %" is by how much they are below the first way's.
    poses: frames that are measured.

    The driver's face at rest is a random one of ICT-FaceKit, which its identity components cannot
    show: a tracker finds what is missing as expressions, which then leak into the driven head.
    """
    rng = np.random.default_rng(7)
    weights = random_poses(poses + QUIET_FRAMES, rng)
    weights[:QUIET_FRAMES] = 0.02 * weights[:QUIET_FRAMES]
    take = Performance(np.arange(len(weights)) / 30, weights, np.zeros(3), 30.0)
    leaked = _leaked(driver)
    tracked = [replace(frame, expr=frame.expr + leaked) for frame in driver.map.frames(take)]
    quiet = quiet_neutral(tracked)
    relative = exchanged_neutral(tracked, quiet)
    found_weights = arkit_weights(relative, driver.map, driver.sequence)[QUIET_FRAMES:]
    copied = _values(tracked)
    from_quiet = _values(relative)
    rest = driver.points(np.concatenate([quiet["face"], quiet["jaw"]]))
    scale = np.linalg.norm(driven.rest - driven.rest.mean(axis=0)) / np.linalg.norm(
        driver.rest - driver.rest.mean(axis=0)
    )
    displaced = [driven.rest + scale * (driver.points(row) - rest) for row in copied]
    own = _values(driven.map.frames(take))
    true = [driven.true_points(row) for row in weights[QUIET_FRAMES:]]
    by_weights = driven.map.parameters(found_weights)[:, : driven.count + 3]
    ways = {
        "coefficients copied": copied,
        "coefficients, relative to the quiet face": from_quiet,
        "displacements of the points, fitted": _fitted(driven, displaced, from_quiet),
        "ARKit weights and this head's map": by_weights,
        "ARKit weights, what they do fitted": _fitted(
            driven, [driven.true_points(row) for row in found_weights], by_weights
        ),
        "this head's own coefficients": own,
        "best of this model": _fitted(driven, true, own),
    }
    print("\n## Another person's motion\n")
    print("| way | from ICT-FaceKit mm | less % | from own coefficients mm | less % |")
    print("|---|---|---|---|---|")
    first: np.ndarray | None = None
    for name, values in ways.items():
        points = [driven.points(row) for row in values]
        missed = np.array(
            [
                np.mean([mean_distance(p, t) for p, t in zip(points, true, strict=True)]),
                np.mean(
                    [mean_distance(p, driven.points(v)) for p, v in zip(points, own, strict=True)]
                ),
            ]
        )
        first = missed if first is None else first
        less = 100 * (1 - missed / first)
        print(
            f"| {name} | {missed[0]:.3f} | {less[0]:.0f} | {missed[1]:.3f} | {less[1]:.0f} |",
            flush=True,
        )


def _leaked(driver: Head) -> np.ndarray:
    """(E,) expression coefficients that a tracker finds in the driver's face at rest."""
    shapes = face_shapes()
    other = np.tensordot(
        np.random.default_rng(7).normal(0, 1, len(shapes.identity)), shapes.identity, 1
    )
    _, slopes = driver.posed.linearized(np.zeros(driver.count), np.zeros(RIGID_SIZE))
    matrix = slopes[..., : driver.count].reshape(-1, driver.count)
    normal = matrix.T @ matrix + LEAK_RIDGE_M**2 * len(driver.rest) * np.eye(driver.count)
    return np.asarray(np.linalg.solve(normal, matrix.T @ other[driver.map.used].ravel()))


def _values(frames: list[FlameFrame]) -> np.ndarray:
    """(T, E + 3) expressions and jaw, without the quiet frames at the beginning."""
    return np.stack(
        [np.concatenate([frame.expr, frame.jaw_pose]) for frame in frames[QUIET_FRAMES:]]
    )


def _fitted(head: Head, wanted: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    return np.stack([head.free_fit(points, row) for points, row in zip(wanted, start, strict=True)])


def there_and_back(head: Head) -> np.ndarray:
    """(52,) largest error of each weight over 300 random poses."""
    weights = random_poses(300, np.random.default_rng(11))
    take = Performance(np.arange(len(weights)) / 30, weights, np.zeros(3), 30.0)
    back = arkit_weights(head.map.frames(take), head.map, head.sequence)
    return np.asarray(np.abs(back - effective_weights(weights)).max(axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--components", type=int, default=50)
    parser.add_argument("--leak-poses", type=int, default=200)
    options = parser.parse_args()
    model = generated_flame(options.data, options.components)
    heads = [Head(model, seed) for seed in range(IDENTITIES)]
    used = heads[0].map.used.sum()
    seconds = heads[0].seconds
    print(f"{used} face points, {model.n_expression} expressions; the map took {seconds:.1f} s\n")
    combinations(heads, options.poses)
    leaks(heads[1], heads[2], options.leak_poses)
    errors = there_and_back(heads[0])
    print(f"\n## Per shape\n\n{(errors < 0.01).sum()} of {len(errors)} weights", end=" ")
    print("come back within 0.01\n")
    print("| shape | error there and back |\n|---|---|")
    for name, error in zip(ARKIT_SHAPES, errors, strict=True):
        print(f"| {name} | {error:.4f} |")


if __name__ == "__main__":
    main()
