"""How well ARKit's shapes drive FLAME heads: distances, leaks of identity, and the way back.

    python benchmarks/driving.py DATA [--poses 1000] [--components 50]

DATA is the folder of `flame_open/flame2023_open_basis.npz`. FLAME's expressions are not published openly, so the heads
have generated ones (tests/driving/heads.py). Prints, for three identities with a third of the poses each: mean distance
at the face points of the map's poses from ICT-FaceKit's shapes on that head, beside that of a fit of expressions and
jaw to each pose alone; the mean distance from a head's true poses when it is driven by the parameters of another person
whose face leaks into the expressions; the largest error of each weight after parameters and back; and per shape how
much of it the head can do.
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from driving.heads import generated_flame, random_poses

from stga_addon.driving.head_map import HeadMap, head_map
from stga_addon.driving.inverse import arkit_weights
from stga_addon.driving.names import ARKIT_SHAPES
from stga_addon.driving.performance import Performance
from stga_addon.driving.shapes import effective_weights, face_shapes
from stga_addon.driving.transfer import exchanged_neutral, quiet_neutral
from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.model import JOINTS, FlameModel
from stga_addon.flame.sequence import FlameSequence, with_identity
from stga_addon.tracking.posed_points import RIGID_SIZE, PosedPoints

IDENTITIES = 3
FREE_STEPS = 3
SINGULAR = 1e-12
"""Ridge of the free fit, which only keeps its equations solvable."""
LEAK_RIDGE_M = 1e-4
QUIET_FRAMES = 100
JAW = 3 * JOINTS.index("jaw")


class Head:
    """One identity of a model, its map, and its face points."""

    def __init__(self, model: FlameModel, seed: int) -> None:
        shape = np.random.default_rng(seed).normal(0, 1.0, model.n_identity)
        self.sequence = FlameSequence(model, shape, None, (), {}.__getitem__)
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
        return self.posed.positions(values[: self.count], self.rigid(values[self.count : self.count + 3]))

    def true_points(self, weights: np.ndarray) -> np.ndarray:
        """(N, 3) where ICT-FaceKit's shapes put this head's face points."""
        return np.asarray(self.rest + np.tensordot(effective_weights(weights), self.map.targets, 1))

    def free_fit(self, wanted: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Expressions and jaw by Gauss-Newton, without a map."""
        values, columns = (
            start[: self.count + 3].copy(),
            [*range(self.count), *range(self.count + JAW, self.count + JAW + 3)],
        )
        for _ in range(FREE_STEPS):
            at, slopes = self.posed.linearized(values[: self.count], self.rigid(values[self.count :]))
            matrix = slopes[..., columns].reshape(-1, len(columns))
            normal = matrix.T @ matrix
            normal[np.diag_indices(len(normal))] += SINGULAR
            values += np.linalg.solve(normal, matrix.T @ (wanted - at).ravel())
        return values


def mean_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Millimeters."""
    return 1000 * float(np.linalg.norm(first - second, axis=1).mean())


def combinations(heads: list[Head], poses: int) -> None:
    print("## Combinations\n\n| identity | motion mm | map mm | free fit mm | map / free fit | max coefficient |")
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
        print(
            f"| {number} | {motion:.3f} | {missed:.3f} | {best:.3f} | {missed / best:.3f} | {largest:.1f} |", flush=True
        )


def leaks(driver: Head, driven: Head) -> None:
    """The driver's expressions hold what the identity components do not: a random ICT-FaceKit face."""
    rng, shapes = np.random.default_rng(7), face_shapes()
    other = np.tensordot(rng.normal(0, 1, len(shapes.identity)), shapes.identity, 1)[driver.map.used]
    _, slopes = driver.posed.linearized(np.zeros(driver.count), np.zeros(RIGID_SIZE))
    matrix = slopes[..., : driver.count].reshape(-1, driver.count)
    normal = matrix.T @ matrix + LEAK_RIDGE_M**2 * len(other) * np.eye(driver.count)
    bias = np.linalg.solve(normal, matrix.T @ other.ravel())
    weights = random_poses(300, rng)
    weights[:QUIET_FRAMES] = 0.02 * weights[:QUIET_FRAMES]
    take = Performance(np.arange(len(weights)) / 30, weights, None, 30.0)
    tracked = [
        FlameFrame(f.expr + bias, f.rotation, f.neck_pose, f.jaw_pose, f.translation, f.eyes_pose)
        for f in driver.map.frames(take)
    ]
    relative = exchanged_neutral(tracked, quiet_neutral(tracked))
    results = []
    for frames in (tracked, relative):
        values = [np.concatenate([frame.expr, frame.jaw_pose]) for frame in frames]
        apart = [mean_distance(driven.points(v), driven.true_points(w)) for v, w in zip(values, weights, strict=True)]
        results.append(np.mean(apart[QUIET_FRAMES:]))
    less = 100 * (1 - results[1] / results[0])
    print("\n## Another person's motion\n")
    print(
        f"copied: {results[0]:.3f} mm; relative to the quiet face: {results[1]:.3f} mm, {less:.0f} % less", flush=True
    )


def there_and_back(head: Head) -> np.ndarray:
    """(52,) largest error of each weight over 300 random poses."""
    weights = random_poses(300, np.random.default_rng(11))
    take = Performance(np.arange(len(weights)) / 30, weights, None, 30.0)
    back = arkit_weights(head.map.frames(take), head.map, head.sequence)
    return np.asarray(np.abs(back - effective_weights(weights)).max(axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--components", type=int, default=50)
    options = parser.parse_args()
    model = generated_flame(options.data, options.components)
    heads = [Head(model, seed) for seed in range(IDENTITIES)]
    used, seconds = heads[0].map.used.sum(), heads[0].seconds
    print(f"{used} face points, {model.n_expression} expressions; the map took {seconds:.1f} s\n")
    combinations(heads, options.poses)
    leaks(heads[1], heads[2])
    errors = there_and_back(heads[0])
    print(f"\n## Per shape\n\n{(errors < 0.01).sum()} of {len(errors)} weights come back within 0.01\n")
    print("| shape | reach % | error there and back |\n|---|---|---|")
    reach = np.mean([head.map.reach for head in heads], axis=0)
    for name, share, error in zip(ARKIT_SHAPES, reach, errors, strict=True):
        print(f"| {name} | {100 * share:.0f} | {error:.4f} |")


if __name__ == "__main__":
    main()
