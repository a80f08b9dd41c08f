"""Choosing the LLVM library: an explicit one first, else the newest that is new enough."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from caviar_protocol.errors import SetupError
from caviar_services.drjit_setup import ENVIRONMENT, INSTALL, activate_llvm, choose_llvm, cuda_devices


def touch(folder: Path, *names: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()


def choose(folder: Path, **environment: str) -> tuple[str, tuple[int, ...]]:
    library = choose_llvm(environment, [f"{folder}/*"], listed=[])
    return library.path.name, library.version


def test_the_newest_of_several_versions_is_taken(tmp_path: Path) -> None:
    touch(tmp_path / "lib", "libLLVM-14.0.6.so", "libLLVM-15.so.1", "libLLVM-18.so.1", "libLLVM.so.19.1")
    assert choose(tmp_path) == ("libLLVM.so.19.1", (19, 1))


def test_nine_is_older_than_nineteen(tmp_path: Path) -> None:
    """Versions compare as numbers, not as text."""
    touch(tmp_path / "lib", "libLLVM-9.so.1", "libLLVM-16.so.1")
    assert choose(tmp_path)[1] == (16,)


def test_other_files_of_llvm_are_no_candidates(tmp_path: Path) -> None:
    touch(tmp_path / "lib", "libLLVMCore.a", "libLLVM-99.txt", "libLLVM-17.so.1")
    assert choose(tmp_path) == ("libLLVM-17.so.1", (17,))


def test_a_bare_name_takes_its_version_from_the_folder(tmp_path: Path) -> None:
    touch(tmp_path / "llvm-18", "libLLVM.so")
    assert choose(tmp_path)[1] == (18,)


def test_a_link_counts_as_what_it_points_to(tmp_path: Path) -> None:
    touch(tmp_path / "lib", "libLLVM-15.so.1", "libLLVM-17.so.1")
    (tmp_path / "lib" / "libLLVM-21.so").symlink_to("libLLVM-15.so.1")
    assert choose(tmp_path) == ("libLLVM-17.so.1", (17,))


def test_the_linker_cache_is_searched_too(tmp_path: Path) -> None:
    touch(tmp_path, "libLLVM.so.20.1")
    assert choose_llvm({}, [], listed=[str(tmp_path / "libLLVM.so.20.1")]).version == (20, 1)


def test_an_explicit_library_comes_first(tmp_path: Path) -> None:
    touch(tmp_path / "lib", "libLLVM-16.so.1", "libLLVM.so.19.1")
    explicit = str(tmp_path / "lib" / "libLLVM-16.so.1")
    assert choose(tmp_path, **{ENVIRONMENT: explicit}) == ("libLLVM-16.so.1", (16,))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("absent.so", "not a file"),
        ("libLLVM-15.so.1", "LLVM 15"),
        ("mine.so", "not an LLVM 16 or newer"),
    ],
)
def test_an_unusable_explicit_library_is_named(tmp_path: Path, name: str, says: str) -> None:
    """It is not replaced in silence, even where a good one is there."""
    touch(tmp_path / "lib", "libLLVM-15.so.1", "mine.so", "libLLVM.so.19.1")
    with pytest.raises(SetupError, match=says) as caught:
        choose(tmp_path, **{ENVIRONMENT: str(tmp_path / "lib" / name)})
    assert name in str(caught.value)
    assert str(caught.value).endswith(INSTALL)


def test_without_a_usable_library_the_command_is_given(tmp_path: Path) -> None:
    touch(tmp_path / "lib", "libLLVM-14.so.1")
    with pytest.raises(SetupError, match=r"found only LLVM 14 \(") as caught:
        choose(tmp_path)
    assert str(caught.value).endswith(INSTALL)


def test_without_any_library_the_command_is_given(tmp_path: Path) -> None:
    with pytest.raises(SetupError) as caught:
        choose_llvm({}, [f"{tmp_path}/*"], listed=[])
    assert str(caught.value).endswith(INSTALL)
    assert "found only" not in str(caught.value)


def test_no_driver_means_no_cuda_device() -> None:
    assert cuda_devices("libnosuchdriver.so.1") == 0


def drjit_holding(version: tuple[int, ...] | None) -> SimpleNamespace:
    return SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: version))


def test_a_library_that_is_held_already_stays_if_new_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setitem(sys.modules, "drjit", drjit_holding((18, 1, 0)))
    assert "18.1.0" in activate_llvm()


def test_a_library_that_is_held_already_and_too_old_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Kernels would abort the process; so it is said before any is compiled."""
    touch(tmp_path, "libLLVM-17.so.1")
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setitem(sys.modules, "drjit", drjit_holding((15, 0, 7)))
    good = choose_llvm({}, [], [str(tmp_path / "libLLVM-17.so.1")])
    monkeypatch.setattr("caviar_services.drjit_setup.choose_llvm", lambda: good)
    with pytest.raises(SetupError, match=r"LLVM.*15\.0\.7.*DRJIT_LIBLLVM_PATH=.*libLLVM-17"):
        activate_llvm()


def test_activating_tells_the_library_to_drjit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    touch(tmp_path, "libLLVM-18.so.1")
    path = str(tmp_path / "libLLVM-18.so.1")
    monkeypatch.setenv(ENVIRONMENT, path)
    assert activate_llvm() == f"LLVM 18 ({path})"
