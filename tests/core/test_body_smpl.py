"""SMPL-format files: what is read, what is refused, and that nothing in a pickle runs."""

from __future__ import annotations

import pickle
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from rsavatar.body.base import BodyModel
from rsavatar.body.find import find_body
from rsavatar.body.smpl import load_body, save_body
from rsavatar.errors import BodyError
from tests.core.bodies import PARENTS, saved, smpl_arrays, synthetic_body, write_pickle

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


class Touches:
    """Unpickled naively, it creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
def test_every_pickle_protocol_gives_the_same_body(tmp_path: Path, protocol: int) -> None:
    arrays = smpl_arrays()
    body = load_body(write_pickle(tmp_path / "b.pkl", arrays, protocol))
    assert body.parents == PARENTS
    np.testing.assert_array_equal(body.joint_regressor, arrays["J_regressor"].toarray())
    np.testing.assert_array_equal(body.pose_directions, arrays["posedirs"])
    assert body.faces.dtype == np.int64


def test_compressed_rows_and_columns_are_the_same_matrix(tmp_path: Path) -> None:
    arrays = smpl_arrays()
    by_column = load_body(write_pickle(tmp_path / "c.pkl", arrays))
    arrays["J_regressor"] = scipy.sparse.csr_matrix(arrays["J_regressor"])
    assert load_body(write_pickle(tmp_path / "r.pkl", arrays)).sha256 == by_column.sha256


def test_old_module_paths_are_understood(tmp_path: Path) -> None:
    path = write_pickle(tmp_path / "b.pkl", smpl_arrays(), protocol=0)
    new = load_body(path)
    text = path.read_bytes().replace(b"numpy._core.", b"numpy.core.").replace(b"scipy.sparse._csc", b"scipy.sparse.csc")
    assert text != path.read_bytes()
    path.write_bytes(text)
    assert load_body(path).sha256 == new.sha256


def test_chumpy_arrays_are_unwrapped_without_chumpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = smpl_arrays()
    plain = load_body(write_pickle(tmp_path / "plain.pkl", arrays))
    module = types.ModuleType("chumpy.ch")
    module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})  # type: ignore[attr-defined]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        patch.setitem(sys.modules, "chumpy.ch", module)
        wrapped = module.Ch()
        wrapped.__dict__.update(x=arrays["shapedirs"], _cache={})
        path = write_pickle(tmp_path / "b.pkl", {**arrays, "shapedirs": wrapped})
    assert load_body(path).sha256 == plain.sha256


@pytest.mark.parametrize("key", ["weights", "extra"])
def test_a_pickle_that_names_code_is_refused_and_does_not_run(tmp_path: Path, key: str) -> None:
    trap = tmp_path / "ran"
    path = write_pickle(tmp_path / "b.pkl", {**smpl_arrays(), key: Touches(trap)})
    with pytest.raises(BodyError, match="refused"):
        load_body(path)
    assert not trap.exists()


def test_an_object_in_an_npz_is_refused_and_does_not_run(tmp_path: Path) -> None:
    trap = tmp_path / "ran"
    arrays = {**smpl_arrays(), "weights": np.array(Touches(trap), dtype=object)}
    np.savez(tmp_path / "b.npz", allow_pickle=True, **arrays)
    with pytest.raises(BodyError, match="refused"):
        load_body(tmp_path / "b.npz")
    assert not trap.exists()


def test_stand_ins_cannot_be_reprogrammed(tmp_path: Path) -> None:
    """A BUILD opcode may set attributes: on the stand-ins for functions there are none to set."""
    stream = b"\x80\x02c_codecs\nencode\n}X\x01\x00\x00\x00aK\x01sb."
    (tmp_path / "b.pkl").write_bytes(stream)
    with pytest.raises(BodyError, match="readable"):
        load_body(tmp_path / "b.pkl")


def test_a_sparse_regressor_in_an_npz_is_read(tmp_path: Path) -> None:
    arrays = smpl_arrays()
    np.savez(
        tmp_path / "b.npz", allow_pickle=True, **{**arrays, "J_regressor": np.array(arrays["J_regressor"], object)}
    )
    assert load_body(tmp_path / "b.npz").sha256 == load_body(write_pickle(tmp_path / "b.pkl", arrays)).sha256


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    body = synthetic_body(tmp_path)
    assert load_body(saved(tmp_path / "b.npz", body)).sha256 == body.sha256


@pytest.mark.parametrize("shapes", [3, 10, 300])
def test_there_are_always_ten_shape_directions(tmp_path: Path, shapes: int) -> None:
    arrays = smpl_arrays(shapes=shapes)
    body = load_body(write_pickle(tmp_path / "b.pkl", arrays))
    kept = min(10, shapes)
    np.testing.assert_array_equal(body.shape_directions[..., :kept], arrays["shapedirs"][..., :kept])
    assert not body.shape_directions[..., kept:].any()


def test_pose_directions_of_zeros_are_none(tmp_path: Path) -> None:
    arrays = smpl_arrays()
    arrays["posedirs"] = np.zeros_like(arrays["posedirs"])
    assert load_body(write_pickle(tmp_path / "b.pkl", arrays)).pose_directions is None


BAD: list[tuple[str, dict[str, object], str]] = [
    ("joints", {"kintree_table": np.zeros((2, 52))}, "kintree_table"),
    ("weights", {"weights": np.ones((60, 24))}, "sum to 1"),
    ("nan", {"v_template": np.full((60, 3), np.nan)}, "finite"),
    ("faces", {"f": np.full((5, 3), 60)}, "faces"),
    ("text", {"v_template": "hello"}, "v_template"),
    ("pose", {"posedirs": np.ones((60, 3, 9))}, "posedirs"),
]


@pytest.mark.parametrize(("change", "message"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_a_bad_body_is_refused_by_name(tmp_path: Path, change: dict[str, object], message: str) -> None:
    with pytest.raises(BodyError, match=message):
        load_body(write_pickle(tmp_path / "b.pkl", {**smpl_arrays(), **change}))


def test_a_missing_key_file_or_suffix_is_named(tmp_path: Path) -> None:
    arrays = smpl_arrays()
    del arrays["weights"]
    with pytest.raises(BodyError, match="weights"):
        load_body(write_pickle(tmp_path / "b.pkl", arrays))
    with pytest.raises(BodyError, match="no file"):
        load_body(tmp_path / "absent.npz")
    with pytest.raises(BodyError, match="ending in"):
        load_body(write_pickle(tmp_path / "b.txt", arrays))


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    whole = pickle.dumps(smpl_arrays())
    (tmp_path / "b.pkl").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "b.npz").write_bytes(b"no zip")
    for name in ("b.pkl", "b.npz"):
        with pytest.raises(BodyError):
            load_body(tmp_path / name)


def test_parents_must_come_before_their_children(tmp_path: Path) -> None:
    body = synthetic_body(tmp_path)
    for parents in ((-1, 2, *PARENTS[2:]), (0, *PARENTS[1:]), PARENTS[:-1]):
        with pytest.raises(BodyError, match="parents"):
            replace(body, parents=parents)


def test_rest_joints_are_the_regressor_applied_to_the_shaped_body(tmp_path: Path) -> None:
    body = synthetic_body(tmp_path)
    shapes = np.random.default_rng(1).normal(size=10)
    np.testing.assert_allclose(body.rest_joints(shapes), body.joint_regressor @ body.shaped(shapes), atol=1e-12)


class Place:
    """A subject as far as the search for its body is concerned."""

    def __init__(self, root: Path, body: Path | None = None) -> None:
        self.root = root
        self.body = body


@pytest.mark.parametrize(
    "place", ["a/b/body.npz", "a/body_smpl.npz", "SMPL_NEUTRAL.npz", "a/body/body_smpl.npz", "body/body.npz"]
)
def test_auto_finds_the_body_beside_the_subject(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    monkeypatch.delenv("RSAVATAR_BODY", raising=False)
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    wanted = synthetic_body(tmp_path)
    save_body(path, wanted)
    (tmp_path / "body-0.pkl").unlink()
    found, why = find_body("auto", Place(tmp_path / "a" / "b"))
    assert found.sha256 == wanted.sha256
    assert str(path) in why


def test_auto_prefers_the_subjects_own_body_then_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bodies = [synthetic_body(tmp_path, seed) for seed in range(3)]
    own, named, beside = (
        saved(tmp_path / f"{n}.npz", b) for n, b in zip(("own", "named", "body"), bodies, strict=True)
    )
    monkeypatch.setenv("RSAVATAR_BODY", str(named))
    assert find_body("auto", Place(tmp_path, own))[0].sha256 == bodies[0].sha256
    assert find_body("auto", Place(tmp_path))[0].sha256 == bodies[1].sha256
    monkeypatch.delenv("RSAVATAR_BODY")
    assert find_body("auto", Place(tmp_path))[0].sha256 == bodies[2].sha256
    found, why = find_body(str(beside), None)
    assert found.sha256 == bodies[2].sha256
    assert "as asked" in why


@pytest.mark.shared
def test_the_shared_body_is_read() -> None:
    path = SHARED / "body" / "body_smpl.npz"
    if not path.is_file():
        pytest.skip("no shared/body beside the checkout")
    body: BodyModel = load_body(path)
    assert body.vertices == 6890
    assert body.parents == PARENTS
    assert body.pose_directions is None
    assert 1.4 < np.ptp(body.v_template[:, 1]) < 2.1  # metres, y up
