"""Thins a triangle mesh to fewer of its own vertices, so that whatever is bound to a vertex stays valid."""

from __future__ import annotations

import heapq

import numpy as np

from rsavatar.body.base import Array, Indices

_EVENNESS = 1e-3  # share of the squared edge length in the cost: breaks ties on flat parts towards even spacing
_LEAST_COSINE = 0.2  # a remaining triangle may turn by no more than this
_MOST_NEIGHBOURS = 12


class _Mesh:
    """Faces by number and, per vertex, its faces and its quadric (sum of squared plane distances, Garland-Heckbert)."""

    def __init__(self, vertices: Array, faces: Indices) -> None:
        self.points = vertices
        self.faces = {f: tuple(corners) for f, corners in enumerate(faces.tolist())}
        self.around: list[set[int]] = [set() for _ in vertices]
        normals = _normals(vertices[faces])
        area = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
        planes = np.concatenate([normals, -(normals * vertices[faces[:, 0]]).sum(1, keepdims=True)], 1) / area
        quadrics = planes[:, :, None] * planes[:, None, :] * area[:, :, None]
        self.quadrics = np.zeros((len(vertices), 4, 4))
        for corner in range(3):
            np.add.at(self.quadrics, faces[:, corner], quadrics)
        for f, corners in self.faces.items():
            for vertex in corners:
                self.around[vertex].add(f)

    def neighbours(self, vertex: int) -> set[int]:
        """Vertices that share an edge."""
        return {other for f in self.around[vertex] for other in self.faces[f]} - {vertex}

    def costs(self, kept: Indices, gone: Indices) -> Array:
        """What putting ``gone`` onto ``kept`` costs, for some pairs."""
        points = np.concatenate([self.points[kept], np.ones((len(kept), 1))], 1)
        steps = self.points[kept] - self.points[gone]
        quadrics = self.quadrics[gone]
        scale = np.einsum("nii->n", quadrics[:, :3, :3])
        total: Array = np.einsum("ni,nij,nj->n", points, quadrics, points) + _EVENNESS * scale * (steps**2).sum(1)
        return total

    def can_collapse(self, kept: int, gone: int) -> bool:
        """Whether the surface stays a surface and no triangle turns over; boundary vertices never go."""
        shared = self.around[kept] & self.around[gone]
        ring = self.neighbours(gone)
        if len(shared) != 2 or len(ring) != len(self.around[gone]):
            return False
        if len(ring & self.neighbours(kept)) != 2 or len(ring | self.neighbours(kept)) > _MOST_NEIGHBOURS:
            return False
        return self._keep_sides(self.around[gone] - shared, kept, gone)

    def _keep_sides(self, faces: set[int], kept: int, gone: int) -> bool:
        corners = np.array([self.faces[f] for f in sorted(faces)])
        before, after = _normals(self.points[corners]), _normals(self.points[np.where(corners == gone, kept, corners)])
        scale = np.sqrt((before**2).sum(1) * (after**2).sum(1))
        return bool(((before * after).sum(1) > _LEAST_COSINE * scale).all())

    def collapse(self, kept: int, gone: int) -> None:
        """Puts ``gone`` onto ``kept``."""
        for f in self.around[gone] & self.around[kept]:
            for vertex in self.faces.pop(f):
                self.around[vertex].discard(f)
        for f in self.around[gone]:
            self.faces[f] = tuple(kept if v == gone else v for v in self.faces[f])
            self.around[kept].add(f)
        self.around[gone] = set()
        self.quadrics[kept] += self.quadrics[gone]


def _normals(corners: Array) -> Array:
    """Normals [N, 3] of triangles [N, 3, 3], twice the area long."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], 1)


def thinned(vertices: Array, faces: Indices, count: int) -> tuple[Indices, Indices]:
    """Removes the vertices that the surface misses least until ``count`` are left, or no more can go.

    Half-edge collapses in the order of their quadric error; the vertices that stay do not move.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        count: number of vertices wanted.

    Returns:
        Indices [count] of the vertices that stay, ascending, and faces among them [F', 3].
    """
    mesh = _Mesh(vertices, faces)
    used = {v for v in range(len(vertices)) if mesh.around[v]}
    heap = _priced(mesh, [(kept, gone) for gone in sorted(used) for kept in sorted(mesh.neighbours(gone))])
    heapq.heapify(heap)
    left = len(used)
    while heap and left > count:
        cost, kept, gone = heapq.heappop(heap)
        if not mesh.around[gone] or not mesh.around[kept]:
            continue
        now = _priced(mesh, [(kept, gone)])[0]
        if now[0] > cost * (1 + 1e-9):  # its quadric has grown since
            heapq.heappush(heap, now)
        elif mesh.around[kept] & mesh.around[gone] and mesh.can_collapse(kept, gone):
            ring = sorted(mesh.neighbours(gone) - {kept})
            mesh.collapse(kept, gone)
            left -= 1
            pairs = [pair for other in ring for pair in ((kept, other), (other, kept))]
            for entry in _priced(mesh, pairs):
                heapq.heappush(heap, entry)
    triangles = np.array([mesh.faces[f] for f in sorted(mesh.faces)], np.int64)
    stay, inverse = np.unique(triangles, return_inverse=True)
    return stay, inverse.reshape(-1, 3)


def _priced(mesh: _Mesh, pairs: list[tuple[int, int]]) -> list[tuple[float, int, int]]:
    """(cost, kept, gone) of each pair (kept, gone)."""
    kept, gone = np.array(pairs).T
    return [(cost, *pair) for cost, pair in zip(mesh.costs(kept, gone).tolist(), pairs, strict=True)]
