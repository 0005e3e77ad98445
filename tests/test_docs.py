"""The pages: generated ones are what their generators give, links lead somewhere, the site builds, notebooks run."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import crazyem

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
# The aim is 35 000 words: lower this number, never raise it.
MOST_WORDS, MOST_README_WORDS, WIDEST, LONGEST_SENTENCE = 34_950, 1200, 120, 35


def without_code(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def prose(page: Path) -> list[str]:
    return [line for line in without_code(page).split("\n") if not line.startswith(("|", "    ", "<!--"))]


def test_the_page_of_commands_is_what_the_parser_says():
    spec = importlib.util.spec_from_file_location("commands_page", ROOT / "docs" / "commands_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), "run python docs/commands_page.py"


def test_the_page_of_the_api_has_every_exported_name():
    page = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^::: (crazyem\.\S+)$", page, flags=re.MULTILINE))
    exported = {f"crazyem.{home}.{name}" for name, home in crazyem._HOME.items() if home != "errors"}
    assert exported <= named
    assert "crazyem.errors" in named


def test_links_lead_to_files():
    links = [(page, target) for page in PAGES for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page))]
    files = [(page, target) for page, target in links if "://" not in target and not target.startswith("#")]
    assert [f"{p}: {t}" for p, t in files if not (p.parent / t.partition("#")[0]).exists()] == []


def test_the_pages_are_short_enough_to_be_read():
    words = {page: len(without_code(page).split()) for page in PAGES}
    assert words[ROOT / "README.md"] <= MOST_README_WORDS
    assert sum(words.values()) <= MOST_WORDS
    assert [f"{p}: {line}" for p in PAGES for line in prose(p) if len(line) > WIDEST] == []
    sentences = [
        sentence
        for page in PAGES
        for sentence in re.split(r"(?<=[.!?:])\s+|\n\s*\n|\n[-*] ", "\n".join(prose(page)))
        if len(sentence.split()) > LONGEST_SENTENCE
    ]
    assert len(sentences) <= 20, sentences


@pytest.mark.slow
def test_the_site_builds_with_strict_links(tmp_path):
    pytest.importorskip("material", reason="pip install 'crazyem[docs]'")
    pytest.importorskip("mkdocstrings", reason="pip install 'crazyem[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "site" / "reference" / "api" / "index.html").stat().st_size > 50_000


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebooks_run(path, tmp_path):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    shutil.copytree(ROOT / "logs", tmp_path / "logs")
    folder = tmp_path / "docs" / "notebooks"
    folder.mkdir(parents=True)
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}}).execute()
    shown = [o for cell in notebook.cells for o in cell.get("outputs", ()) if "text/html" in o.get("data", {})]
    assert shown, "results show themselves as tables"


def test_there_are_three_notebooks():
    assert len(NOTEBOOKS) == 3
