"""Meshes of the synthetic head: skin with its pockets behind lids and lips, eyeballs and rows of teeth."""

import numpy as np

from .skin import COLUMNS, EYE, EYE_COLUMNS, EYE_RADIUS, EYE_ROW, MOUTH, MOUTH_COLUMNS, MOUTH_ROW, ROWS, neutral_skin

PARTS = ("skin", "mouth", "lid", "eyeball", "teeth")


class SkinGrid:
    """Skin and pockets: positions (V, 3), faces, the grid point each vertex moves with, and parts.

    Vertex order: the rows below the crown, the crown, the slits' lower edges, the pockets.
    """

    def __init__(self, level: int) -> None:
        self.columns, self.rows = COLUMNS * level, (len(ROWS) - 1) * level
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        self.row, self.column = np.append((row + 1) / level, 0.0), np.append(self._signed(column) / level, 0.0)
        rings, above, below = self._cut_slits(level)
        self.skin = neutral_skin(self.row, self.column, np.arange(len(self.row)) > self.rows * self.columns)
        self.faces = self._skin_faces(above, below)
        self.positions, self.source = self.skin.at, np.arange(len(self.row))
        self.part = np.zeros(len(self.row), int)
        for ring, kind in rings:
            self._add_pocket(ring, kind)
        self.coarse = np.flatnonzero((self.row % 1 == 0) & (self.column % 1 == 0))

    def _cut_slits(self, level: int) -> tuple[list[tuple[np.ndarray, str]], np.ndarray, np.ndarray]:
        """Rings of vertices around each slit, and vertex ids (rows, columns) as seen from above and from below."""
        above = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        below = above.copy()
        left, right = EYE_COLUMNS, (-EYE_COLUMNS[1], -EYE_COLUMNS[0])
        rings = []
        for at, (first, last), kind in (
            (EYE_ROW, left, "lid"),
            (EYE_ROW, right, "lid"),
            (MOUTH_ROW, MOUTH_COLUMNS, "mouth"),
        ):
            inner = np.arange(first * level + 1, last * level)
            lower = len(self.row) + np.arange(len(inner))
            self.row = np.append(self.row, np.full(len(inner), float(at)))
            self.column = np.append(self.column, inner / level)
            below[at * level - 1, inner % self.columns] = lower
            upper = above[at * level - 1, np.arange(first * level, last * level + 1) % self.columns]
            rings.append((np.concatenate([upper, lower[::-1]]), kind))
        return rings, above, below

    def _signed(self, column: np.ndarray) -> np.ndarray:
        """Columns counted from the middle of the face: negative on the person's right."""
        return np.where(column > self.columns // 2, column - self.columns, column)

    def _skin_faces(self, above: np.ndarray, below: np.ndarray) -> np.ndarray:
        crown = self.rows * self.columns
        near, far = np.arange(self.columns), (np.arange(self.columns) + 1) % self.columns
        cap = np.stack([np.full(self.columns, crown), above[0][near], above[0][far]], 1)
        quads = [
            np.stack([below[r][near], above[r + 1][near], above[r + 1][far], below[r][far]], 1)
            for r in range(self.rows - 1)
        ]
        return np.concatenate([cap, split_quads(np.concatenate(quads), self.skin.at)])

    def _add_pocket(self, ring: np.ndarray, kind: str) -> None:
        """Continue a slit's edge inwards: behind the lids, or into the mouth."""
        edge = self.skin.at[ring]
        if kind == "lid":
            # Down onto the eyeball, so that no gap shows at the corners.
            eye = EYE * [np.sign(edge[0, 0]), 1, 1]
            inwards = (edge - eye) / np.linalg.norm(edge - eye, axis=1, keepdims=True)
            layers = [edge - [0, 0, 0.0012], eye + 0.96 * EYE_RADIUS * inwards]
        else:
            # The ring runs along the upper lip first.
            apart = np.clip(1 - (edge[:, :1] / 0.0245) ** 2, 0, 1) * [0, 1, 0]
            apart[len(ring) // 2 + 1 :] *= -1
            layers = [
                edge + 0.0006 * apart - [0, 0, 0.003],
                edge * [0.97, 1, 1] + 0.012 * apart - [0, 0, 0.010],
                edge * [0.90, 1, 1] + 0.014 * apart - [0, 0, 0.032],
            ]
        previous, size = ring, len(ring)
        for layer in layers:
            fresh = len(self.positions) + np.arange(size)
            after = np.roll(np.arange(size), -1)
            quads = np.stack([previous[after], previous, fresh, fresh[after]], 1)
            self.positions = np.concatenate([self.positions, layer])
            self.source = np.append(self.source, self.source[ring])
            self.part = np.append(self.part, np.full(size, PARTS.index(kind)))
            self.faces = np.concatenate([self.faces, split_quads(quads, self.positions)])
            previous = fresh
        if kind == "mouth":
            # Close the throat: both lips' ends joined by a band, corner to corner.
            upper, lower = previous[: size // 2 + 1], np.append(previous[0], previous[: size // 2 - 1 : -1])
            band = np.stack([lower[:-1], lower[1:], upper[1:], upper[:-1]], 1)
            self.faces = np.concatenate([self.faces, without_degenerate(split_quads(band, self.positions))])


def split_quads(quads: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Two triangles of each quad (N, 4), cut along the shorter diagonal."""
    a, b, c, d = quads.T
    short = np.linalg.norm(at[a] - at[c], axis=1) <= np.linalg.norm(at[b] - at[d], axis=1) + 1e-9
    first = np.where(short, [a, b, c], [a, b, d])
    second = np.where(short, [a, c, d], [b, c, d])
    return np.asarray(np.stack([first, second], 1).transpose(2, 1, 0).reshape(-1, 3))


def without_degenerate(faces: np.ndarray) -> np.ndarray:
    """Triangles with three different corners."""
    a, b, c = faces.T
    return np.asarray(faces[(a != b) & (b != c) & (c != a)])


def eyeball_mesh(center: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """A globe (points, triangles) whose pole looks forward."""
    rings, around = 7 * level, 12 * level
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(around) / around
    shell = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.cos(polar)[:, None] + 0 * turn,
        ],
        -1,
    ).reshape(-1, 3)
    points = np.concatenate([shell, [[0, 0, 1], [0, 0, -1]]])
    ids = np.arange(len(shell)).reshape(rings - 1, around)
    after = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], ids[1:], after[1:], after[:-1]], -1).reshape(-1, 4)
    pole = np.full(around, len(shell))
    caps = [np.stack([pole, ids[0], after[0]], 1), np.stack([pole + 1, after[-1], ids[-1]], 1)]
    return center + EYE_RADIUS * points, np.concatenate([split_quads(quads, points), *caps])


def tooth_row_mesh(level: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """A curved band (points, triangles) behind the upper (`up` 1) or lower (-1) lip."""
    across, down = 12 * level, 2 * level
    bow = np.linspace(-1.15, 1.15, across + 1)
    drop = np.linspace(0.0, 1.0, down + 1)
    x = 0.0225 * np.sin(bow) / np.sin(1.15)
    z = MOUTH[2] - 0.0055 - (0.0 if up > 0 else 0.0016) - 0.020 * (1 - np.cos(bow))
    edge = MOUTH[1] - (0.0022 if up > 0 else 0.0030)
    y = edge + up * 0.0105 * drop
    points = np.stack(np.broadcast_arrays(x, y[:, None], z), -1).reshape(-1, 3)
    ids = np.arange(len(points)).reshape(down + 1, across + 1)
    corners = [ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]]
    quads = np.stack(corners if up > 0 else corners[::-1], -1).reshape(-1, 4)
    return points, split_quads(quads, points)
