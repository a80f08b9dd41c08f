"""Conformance tests of formats: subclass `FormatConformance` in the tests of a package that adds one."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pytest

from caviar_clients.datasets.reader import Dataset
from caviar_formats import base
from caviar_formats.base import STATE, Format, Part, export_users, find_format
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import RunError


def digests(folder: Path) -> dict[str, str]:
    """Digest of each file of a folder, by its path in it."""
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {file.relative_to(folder).as_posix(): file_digest(file) for file in files}


class FormatConformance:
    """Duties of every format that is written; the fixture ``dataset`` has three scenes at least."""

    name: ClassVar[str]
    """Of the format."""

    @pytest.fixture
    def dataset(self) -> Dataset:
        """A dataset that the format can hold."""
        raise NotImplementedError

    @pytest.fixture(autouse=True)
    def _small_parts(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(base, "SCENES", 2)

    def test_an_export_that_is_cut_off_goes_on_to_the_same_files(
        self, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        whole, cut = tmp_path / "whole", tmp_path / "cut"
        export_users(dataset.users(), find_format(self.name), whole)
        form = find_format(self.name)
        write = type(form).write

        def fail_later(form: Format, part: Part, folder: Path) -> None:
            write(form, part, folder)
            if part.number:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(type(form), "write", fail_later)
            with pytest.raises(KeyboardInterrupt):
                export_users(dataset.users(), form, cut)
        assert not cut.exists()
        done = list[int]()
        export_users(dataset.users(), find_format(self.name), cut, lambda scenes, of: done.append(scenes))
        assert done[-1] == len(dataset.table("scenes"))
        assert digests(cut) == digests(whole)

    def test_an_export_that_is_cut_off_in_its_last_step_loses_nothing(
        self, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        whole, cut = tmp_path / "whole", tmp_path / "cut"
        export_users(dataset.users(), find_format(self.name), whole)
        if not find_format(self.name).temporary:
            return

        def remove_one(folder: Path, **options: bool) -> None:
            next(file for file in sorted(folder.rglob("*")) if file.is_file()).unlink()
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("shutil.rmtree", remove_one)
            with pytest.raises(KeyboardInterrupt):
                export_users(dataset.users(), find_format(self.name), cut)
        export_users(dataset.users(), find_format(self.name), cut)
        assert digests(cut) == digests(whole)

    def test_its_readme_says_what_the_files_are(self, dataset: Dataset, tmp_path: Path) -> None:
        export_users(dataset.users(), find_format(self.name), tmp_path / "out")
        text = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
        assert "## Origin" in text
        assert not find_format(self.name).loses or "## Not in these files" in text
        kinds = {name.rpartition(".")[2] for name in digests(tmp_path / "out")} - {"md"}
        assert all(f".{kind}" in text for kind in kinds), kinds
        assert not (tmp_path / "out" / STATE).exists()

    def test_a_folder_with_files_and_another_export_are_refused(
        self, dataset: Dataset, tmp_path: Path
    ) -> None:
        (tmp_path / "there").mkdir()
        (tmp_path / "there" / "file").touch()
        with pytest.raises(RunError, match="not empty"):
            export_users(dataset.users(), find_format(self.name), tmp_path / "there")
        (tmp_path / "new.part").mkdir()
        (tmp_path / "new.part" / STATE).write_text('{"export": "another", "done": 1}')
        with pytest.raises(RunError, match="another export"):
            export_users(dataset.users(), find_format(self.name), tmp_path / "new")

    def test_a_flavour_that_it_lacks_is_refused(self) -> None:
        with pytest.raises(RunError, match="--flavour 'none'"):
            find_format(self.name, "none")
