"""The problem files of a study in its output folder, so that a report reads no file outside this folder."""

from __future__ import annotations

import os
from pathlib import Path

from optloc.files import access, make_folder, read_bytes, within, written
from optloc.lab.study.design import StudyDesign, design_of_text
from optloc.lab.study.folder import MANIFEST, StudyManifest
from optloc.problem import InvalidProblem

_COPIES = "problems"


def store_problems(design: StudyDesign, folder: Path) -> None:
    """Copy the problem files of a study and their tables to its output folder.

    Files outside the folder of the study file, which `outside=True` allows, are not copied.

    Raises
    ------
    InvalidProblem
        If a file cannot be read or written.
    """
    source = os.path.realpath(design.folder)
    for path in design.files:
        if not path.is_relative_to(source):
            continue
        copy = folder / _COPIES / path.relative_to(source)
        content = read_bytes(path)
        if copy.is_file() and read_bytes(copy) == content:
            continue
        make_folder(copy.parent)
        # Removed first, because the command line replaces files only with --force.
        copy.unlink(missing_ok=True)
        with written(copy) as scratch:
            scratch.write_bytes(content)


def design_of_manifest(manifest: StudyManifest, folder: Path) -> StudyDesign | None:
    """Return the design of a study from its manifest; None if a problem file is missing or invalid.

    Parameters
    ----------
    manifest : StudyManifest
        The manifest of the study.
    folder : Path
        The output folder, which has copies of the problem files. The folder that the manifest names is read only if
        files may name files outside their folders (`--outside`).
    """
    try:
        place = within(folder, _COPIES, str(folder / MANIFEST))
        with access() as found:
            if found.outside and not place.is_dir():
                place = Path(manifest.folder or ".")
        return design_of_text(manifest.text, manifest.name, place, seed=manifest.seed)
    except InvalidProblem:
        return None
