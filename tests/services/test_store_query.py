from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import insert, update

from services.errors import RequestError
from services.store import jobs, leases
from services.store.filters import FIELDS, where
from services.store.query import Both, Comparison, Node, Not, parse
from services.store.records import Filters, Outcome
from services.store.session import Store, db_now
from services.store.tables import JobRow, TagRow
from tests.services.conftest import submit


def one(text: str) -> Comparison:
    node = parse(text)
    assert isinstance(node, Comparison)
    return node


def test_words_are_taken_apart() -> None:
    assert one("state:failed") == Comparison("state", ":", ("failed",), 1)
    assert one("  psnr >= 25.5") == Comparison("psnr", ">=", ("25.5",), 3)
    assert one('notes:"a, b (c)"').values == ("a, b (c)",)
    assert one("state:failed, dead").values == ("failed", "dead")
    assert one("created<2d") == Comparison("created", "<", ("2d",), 1)
    assert parse("") is parse("   ") is None


def test_and_binds_closer_than_or_and_not_closest() -> None:
    a, b = (Comparison("seed", ":", (n,), at) for n, at in (("1", 1), ("2", 8)))
    assert parse("seed:1 seed:2") == Both((a, b), every=True)
    assert parse("seed:1 and seed:2") == Both((a, Comparison("seed", ":", ("2",), 12)), every=True)
    found = parse("seed:1 or not seed:2 seed:3")
    assert isinstance(found, Both)
    assert not found.every
    assert isinstance(found.parts[1], Both)
    assert isinstance(found.parts[1].parts[0], Not)
    group = parse("not (seed:1 or seed:2) and seed:3")
    assert isinstance(group, Both)
    assert group.every
    assert isinstance(group.parts[0], Not)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("failed", r"q: expected field:value at character 1, got 'failed'"),
        ("state:failed )", r"q: expected and, or, or the end at character 14, got '\)'"),
        ("(state:failed", r"a closing parenthesis at character 14, got the end"),
        ("state:", r"a value at character 7, got the end"),
        ("psnr>", r"a value at character 6, got the end"),
        ("seed:1 or", r"field:value at character 10, got the end"),
        ("seed:1 ; drop table jobs", r"field:value at character 8, got '; drop table jobs'"),
        ('notes:"open', r"a value at character 7"),
        ("(" * 40 + "seed:1" + ")" * 40, "at most 30 levels"),
        ("not " * 40 + "seed:1", "at most 30 levels"),
        ("seed:1 " * 200, "at most 1000 characters, got 1400"),
        ("seed:1,", r"a value at character 8, got the end"),
    ],
)
def test_a_mistake_is_told_with_its_place(text: str, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        parse(text)


MISFITS = {
    "colour:red": r"one of the fields id, state.* at character 1, got 'colour'",
    "state:failing": r"state one of cancelled, .* at character 1, got 'failing'",
    "seed:1 psnr>many": r"psnr with a number at character 8, got 'many'",
    "psnr>nan": "psnr with a number",
    "method>a": r"method with one of != : = at character 1",
    "created<soon": r"created with an age such as 2d",
    "created:2d": r"created with one of < <= > >=",
    "psnr>1,2": r"one value after > at character 1, got '1,2'",
    "ablation:no_hands": "ablation one of full, no_rs",
}


def test_a_field_refuses_what_does_not_fit_it() -> None:
    for text, message in MISFITS.items():
        with pytest.raises(RequestError, match=message):
            where(Filters(query=text))


@pytest.fixture
def four(store: Store) -> list[str]:
    """Jobs with one difference each: a seed and T, an old one with a tag, a finished one, one with a flag."""
    plain = submit(store, T=11, seed=7).id
    old = submit(store, method="rs-avatar", T="scanline", notes="50%_done").id
    done = submit(store, method="mad-avatar", subject="wave", T="2K", priority=10).id
    flagged = submit(store, method="rs-avatar", T="K", seed=1, ablation={"no_rs": True, "no_spline": False}).id
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    assert claim.job_id == done
    leases.succeed(store, claim, Outcome({"psnr": 26.5, "ssim": 0.9}, {}, {}, {}, 42, 3.0, 1.0))
    with store.write() as session:
        session.execute(insert(TagRow), [{"job_id": old, "tag": "paper"}, {"job_id": old, "tag": "old"}])
        aged = {"created_at": db_now() - 3 * 86_400.0, "notes": "50%_done"}
        session.execute(update(JobRow).where(JobRow.id == old).values(**aged))
    return [plain, old, done, flagged]


WANTED: dict[str, list[int]] = {
    "": [0, 1, 2, 3],
    "state:queued": [0, 1, 3],
    "state:succeeded,running": [2],
    "state!=queued,running": [2],
    "method:rs-avatar": [1, 3],
    "method:*-avatar": [1, 2, 3],
    "method!=*-avatar": [0],
    "psnr>25": [2],
    "psnr<=25": [],
    "not psnr>25 state:succeeded": [],
    "ssim>=0.9": [2],
    "gaussians:42": [2],
    "tag:paper": [1],
    "tag:pap*": [1],
    "tag!=paper": [0, 2, 3],
    "tag:paper,old": [1],
    "created<2d": [0, 2, 3],
    "created>2d": [1],
    "created>2020-01-01": [0, 1, 2, 3],
    "created<2020-01-01T00:00:00": [],
    "seed:7": [0],
    "seed>0": [0, 3],
    "T:scanline": [1],
    "T:11": [0],
    "T:2K,K": [2, 3],
    "ablation:no_rs": [3],
    "ablation:no_spline": [],
    'notes:"50%_*"': [1],
    "notes:50_*": [],
    "duration<1h": [2],
    "priority:10": [2],
    "subject:wave or tag:paper": [1, 2],
    "(subject:wave or tag:paper) method:mad-avatar": [2],
    "not (subject:wave or tag:paper)": [0, 3],
    "preset:smoke iterations<100": [0, 1, 2, 3],
}


def test_jobs_are_found(store: Store, four: list[str]) -> None:
    found = {text: [job.id for job in jobs.page(store, Filters(query=text), None, 10)] for text in WANTED}
    assert {text: sorted(map(four.index, ids)) for text, ids in found.items()} == WANTED


def test_every_field_is_explained() -> None:
    assert all(field.about for field in FIELDS.values())


fields = st.sampled_from(["state", "seed", "psnr", "tag"])
trees = st.recursive(
    st.tuples(fields, st.sampled_from([":", "!=", "<"]), st.sampled_from(["1", "a-b", "2d"])).map("".join),
    lambda inner: st.one_of(
        inner.map(lambda text: f"not {text}"),
        st.tuples(inner, st.sampled_from([" ", " and ", " or "]), inner).map(lambda t: f"({t[0]}{t[1]}{t[2]})"),
    ),
    max_leaves=6,
)


def show(node: Node) -> str:
    if isinstance(node, Comparison):
        return f"{node.field}{node.operator}{','.join(node.values)}"
    if isinstance(node, Not):
        return f"not {show(node.inside)}"
    return f"({(' and ' if node.every else ' or ').join(map(show, node.parts))})"


@given(trees)
def test_what_is_written_is_read_back(text: str) -> None:
    node = parse(text)
    assert node is not None
    again = parse(show(node))
    assert again is not None
    assert show(again) == show(node)


@given(st.text(max_size=60) | st.text('stae:1,<>=!()"not or and2d ', max_size=60))
def test_any_text_is_understood_or_refused(text: str) -> None:
    with contextlib.suppress(RequestError):
        assert show(parse(text) or one("seed:1"))
