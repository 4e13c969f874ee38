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
        normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
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

    def cost(self, kept: int, gone: int) -> float:
        """What putting ``gone`` onto ``kept`` costs."""
        point = np.append(self.points[kept], 1.0)
        step = self.points[kept] - self.points[gone]
        scale = self.quadrics[gone, :3, :3].trace()
        return float(point @ self.quadrics[gone] @ point + _EVENNESS * scale * (step @ step))

    def can_collapse(self, kept: int, gone: int) -> bool:
        """Whether the surface stays a surface and no triangle turns over; boundary vertices never go."""
        shared = self.around[kept] & self.around[gone]
        ring = self.neighbours(gone)
        if len(shared) != 2 or len(ring) != len(self.around[gone]):
            return False
        if len(ring & self.neighbours(kept)) != 2 or len(ring | self.neighbours(kept)) > _MOST_NEIGHBOURS:
            return False
        return all(self._keeps_side(f, kept, gone) for f in self.around[gone] - shared)

    def _keeps_side(self, face: int, kept: int, gone: int) -> bool:
        before = self.points[list(self.faces[face])]
        after = self.points[[kept if v == gone else v for v in self.faces[face]]]
        n0, n1 = (np.cross(p[1] - p[0], p[2] - p[0]) for p in (before, after))
        return bool(n0 @ n1 > _LEAST_COSINE * np.sqrt((n0 @ n0) * (n1 @ n1)))

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
    heap = [(mesh.cost(a, b), a, b) for b in sorted(used) for a in mesh.neighbours(b)]
    heapq.heapify(heap)
    left = len(used)
    while heap and left > count:
        cost, kept, gone = heapq.heappop(heap)
        if not mesh.around[gone] or not mesh.around[kept]:
            continue
        now = mesh.cost(kept, gone)
        if now > cost * (1 + 1e-9):  # its quadric has grown since
            heapq.heappush(heap, (now, kept, gone))
        elif mesh.around[kept] & mesh.around[gone] and mesh.can_collapse(kept, gone):
            ring = mesh.neighbours(gone)
            mesh.collapse(kept, gone)
            left -= 1
            for other in ring & mesh.neighbours(kept):
                heapq.heappush(heap, (mesh.cost(kept, other), kept, other))
                heapq.heappush(heap, (mesh.cost(other, kept), other, kept))
    triangles = np.array([mesh.faces[f] for f in sorted(mesh.faces)], np.int64)
    stay, inverse = np.unique(triangles, return_inverse=True)
    return stay, inverse.reshape(-1, 3)
