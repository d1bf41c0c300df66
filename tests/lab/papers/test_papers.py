"""The table of papers: each line has its module, its page and both sizes; other names are refused."""

from importlib import import_module
from importlib.resources import files

import pytest

from optloc.base.errors import InvalidProblem
from optloc.lab.papers import PAPERS, paper, reproduction


@pytest.mark.parametrize("name", PAPERS)
def test_every_paper_has_a_study_of_two_sizes_and_a_page(name):
    study = import_module(f"optloc.lab.papers.{paper(name).module}").STUDY
    assert set(study.sizes) == {"quick", "full"}
    assert files("optloc.lab.papers").joinpath(f"{name}.md").read_text(encoding="utf-8").startswith("# ")
    assert study.work(study.sizes["full"]) >= study.work(study.sizes["quick"]) > 0


def test_the_work_of_a_reproduction_is_that_of_its_study():
    study = import_module(f"optloc.lab.papers.{PAPERS['bistatic'].module}").STUDY
    assert reproduction("bistatic", "quick", 1).work == study.work(study.sizes["quick"])


def test_an_unknown_paper_is_refused_with_the_nearest_name():
    with pytest.raises(InvalidProblem, match="no paper 'angels'; did you mean 'angles'"):
        paper("angels")
