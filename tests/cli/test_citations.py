import re
from pathlib import Path

import pytest

import bayessim_jax
from bayessim_jax import systems
from bayessim_jax.cli.bibliography import find_sources, read_bibliography, resolve
from bayessim_jax.cli.citations import used_sources
from bayessim_jax.cli.main import main

PACKAGE = Path(bayessim_jax.__file__).parent
CITED = [
    pytest.param(source, id=f"{path.relative_to(PACKAGE)}: {source}")
    for path in sorted(PACKAGE.rglob("*.py"))
    for source in find_sources(path.read_text(encoding="utf-8"))
    if path.name != "bibliography.py"
]


@pytest.mark.parametrize("source", CITED)
def test_every_source_line_is_in_the_bibliography(source):
    entry = resolve(source, read_bibliography())
    assert entry.year in source
    assert entry.families[0] in source


def test_there_are_source_lines():
    assert len(CITED) > 15


@pytest.mark.parametrize(
    "source",
    [
        "Possas 2020",
        "Barto and Sutton 1983",
        "Barto et al. 1984",
        "Nobody 2020",
        "Possas et al.",
        "Genz and Bretz 92",
    ],
)
def test_a_wrong_source_is_refused(source):
    with pytest.raises(ValueError, match="source"):
        resolve(source, read_bibliography())


def test_the_docs_show_the_same_bibliography():
    docs = PACKAGE.parent / "docs" / "references.bib"
    assert docs.read_bytes() == (PACKAGE / "cli" / "references.bib").read_bytes()


def test_keys_are_unique_and_entries_close():
    text = (PACKAGE / "cli" / "references.bib").read_text(encoding="utf-8")
    keys = re.findall(r"^@\w+\{([^,]+),", text, re.MULTILINE)
    assert len(keys) == len(set(keys)) == len(read_bibliography())
    assert all(entry.text.count("{") == entry.text.count("}") for entry in read_bibliography().values())


def test_what_is_used_is_found_through_calls_and_fields():
    cartpole, pendulum = used_sources([systems.CartPole.create()]), used_sources([systems.Pendulum.create()])
    assert cartpole == ["Barto, Sutton and Anderson 1983"]
    assert pendulum == ["Towers et al. 2024, Pendulum-v1"]


def test_citations_are_printed(capsys, tmp_path):
    assert main(["--citations"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("@software{bayessim_jax,")
    assert text.count("\n@") == len(read_bibliography()) - 1
    (tmp_path / "config.toml").write_text("")
    (tmp_path / "run.json").write_text('{"citations": ["genz1992numerical"]}')
    assert main(["--citations", str(tmp_path)]) == 0
    keys = re.findall(r"^@\w+\{([^,]+),", capsys.readouterr().out, re.MULTILINE)
    assert keys == ["bayessim_jax", "possas2020online", "genz1992numerical"]
    assert main(["--citations", str(tmp_path / "none")]) == 2
