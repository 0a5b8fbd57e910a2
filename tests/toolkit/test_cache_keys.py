"""Keys of the cache: other content, another key; where the environment puts it."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from monopart.geometry.errors import InputError
from monopart.toolkit import cache as cache_module
from monopart.toolkit.cache import content_key, user_cache

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=5,
)


@given(values, values)
def test_other_values_have_another_key(a, b) -> None:
    assert (content_key(a) == content_key(b)) == (repr(a) == repr(b))


def test_keys_tell_types_and_shapes_apart(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"ab")
    zeros = torch.zeros(2, 3)
    things = [zeros, zeros.T, zeros.double(), torch.zeros(0, 3), torch.zeros(0), zeros.int()]
    things += [tmp_path / "f", "ab", ["a", "b"], [["a"], "b"], cache_module, True, 1, 1.0]
    assert len({content_key(t) for t in things}) == len(things)
    assert content_key(zeros[:, :2]) == content_key(torch.zeros(2, 2))
    with pytest.raises(TypeError, match="object"):
        content_key(object())


def test_the_environment_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("MONOPART_CACHE")
    assert user_cache().folder == tmp_path / "monopart" / "frames"
    assert user_cache().facts() == {
        "folder": str(tmp_path / "monopart" / "frames"),
        "entries": 0,
        "bytes": 0,
        "limit_bytes": 4 * 10**9,
    }
    monkeypatch.setenv("MONOPART_CACHE", str(tmp_path / "here"))
    monkeypatch.setenv("MONOPART_CACHE_GB", "0.5")
    assert user_cache().folder == tmp_path / "here" and user_cache().limit == 5 * 10**8
    monkeypatch.setenv("MONOPART_CACHE", "off")
    assert user_cache().folder is None and user_cache().facts()["folder"] is None
    for wrong in ("0", "-1", "nan", "inf", "much"):
        monkeypatch.setenv("MONOPART_CACHE_GB", wrong)
        with pytest.raises(InputError, match="MONOPART_CACHE_GB"):
            user_cache()
