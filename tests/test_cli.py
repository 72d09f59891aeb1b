"""Command line: outputs, environment, exit codes and sample logs."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jsonschema
import pypdf
import pytest
from batch_tools import tiny_log
from cli_tools import contents, error_line, run_checked, run_main
from conftest import REPOSITORY as ROOT

from px4fuse.results.contract import schema

pytestmark = pytest.mark.usefixtures("cached_analyses")


def test_numeric_libraries_use_one_thread_by_default(monkeypatch, capsys):
    """With more threads, tune takes twice the CPU time and the same wall time."""
    environment = {"OPENBLAS_NUM_THREADS": "3"}
    monkeypatch.setattr(os, "environ", environment)
    assert run_main(monkeypatch, capsys, "--version")[0] == 0
    assert environment["OMP_NUM_THREADS"] == environment["VECLIB_MAXIMUM_THREADS"] == "1"
    assert environment["OPENBLAS_NUM_THREADS"] == "3"


@pytest.fixture(scope="module")
def report(tmp_path_factory, sample_log) -> tuple[Path, str]:
    """Report of the sample log with special characters in name, id and notes."""
    folder = tmp_path_factory.mktemp("report")
    notes = folder / "notes.md"
    notes.write_text(
        "# What I saw\n\nCosts $5 and $x^2$ or \\frac{1}{2}; **bold**, _under_, <b>tag</b>.\n"
        "- a bullet\n1. numbered\n"
        + "word" * 300
        + "\n\nสวัสดี 你好 \N{GRINNING FACE}\n"
        + "line " * 4000,
        encoding="utf-8",
    )
    own = "--student", "Ana $x$ Müller 李 " * 9, "--id", "$^2_", "--notes", notes
    result = run_checked(
        "compare", sample_log, "-o", folder / "report.pdf", *own, "--sigma-z", "0.12"
    )
    return folder, result.output


def test_results_attached_to_report_pdf_contain_no_file_paths(report):
    folder, said = report
    assert sorted(p.name for p in folder.iterdir()) == ["notes.md", "report.json", "report.pdf"]
    assert (
        "warning[kf_underconfident]: KF is underconfident along the axis of largest motion" in said
    )
    assert f"Wrote    {folder / 'report.pdf'}" in said
    assert len(said.splitlines()) <= 42, "the summary must stay short"
    text = (folder / "report.json").read_bytes()
    assert pypdf.PdfReader(folder / "report.pdf").attachments["results.json"] == [text]
    results = json.loads(text)
    jsonschema.validate(results, schema())
    assert results["provenance"]["command"] == "px4fuse compare aisle_uwb.ulg --sigma-z 0.12"
    assert results["settings"]["sigma_z_m"] == 0.12


def test_report_prints_special_characters_in_name_and_notes(report):
    pages = [page.extract_text() for page in pypdf.PdfReader(report[0] / "report.pdf").pages]
    assert "Ana $x$ Müller" in pages[0]
    assert "Costs $5 and $x^2$ or \\frac{1}{2}; bold, under, tag." in "\n".join(pages)
    assert sum("line line line" in page for page in pages) > 1  # long notes need several pages


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("severity", "code"), [("note", 1), ("warning", 1), ("error", 0)])
def test_compare_option_fail_on_sets_exit_code_by_severity(tmp_path, sample_log, severity, code):
    command = "compare", sample_log, "-o", tmp_path / "a.pdf", "--fail-on", severity
    run_checked(*command, "--sigma-z", "0.12", code=code)  # the finding is a warning
    run_checked(*command, code=0)  # the flight has no finding


def test_help_command_does_not_import_slow_libraries():
    """--help is fast only without the imports of pandas, matplotlib and scipy."""
    code = (
        "import sys\n"
        "from px4fuse.cli import cli\n"
        "cli.main(['--help'], standalone_mode=False)\n"
        "heavy = {'pandas', 'matplotlib', 'scipy', 'numpy', 'pyulog', 'filterpy', 'rich'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    assert "compare" in finished.stdout


@pytest.mark.process
def test_compare_does_not_import_slow_parts_of_scipy(tmp_path, sample_log):
    """Their imports take 0.3 s of the 3 s of a comparison."""
    code = (
        "import sys\n"
        "from px4fuse.cli import cli\n"
        f"cli.main(['compare', {str(sample_log)!r}, '-o', 'a.pdf'], standalone_mode=False)\n"
        "heavy = {'scipy.stats', 'scipy.signal'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert finished.returncode == 0, finished.stderr


def test_compare_accepts_invalid_bytes_in_student_name(tmp_path, sample_log):
    part = "--axis", "north", "--start", "20", "--end", "40"
    own = "--student", "bad\udcff", "--id", "9" * 10_000
    run_checked("compare", sample_log, *part, "-o", tmp_path / "r.pdf", *own)
    student = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))["student"]
    assert student == {"name": "bad?", "id": "9" * 10_000, "notes": ""}


# --------------------------------------------------------------------------- sample and versions


@pytest.fixture
def samples_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the sample logs as their package does, and change to an empty folder."""
    shutil.copytree(ROOT / "sample_logs", tmp_path / "site" / "px4fuse_samples")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")


@pytest.mark.usefixtures("samples_installed")
def test_sample_command_writes_logs_and_prints_next_command() -> None:
    assert run_checked("sample").output.splitlines()[0].split(maxsplit=1) == [
        "Run", f"px4fuse compare {Path('sample_logs') / 'aisle_uwb.ulg'}"
    ]  # fmt: skip
    report, shipped = (contents(folder / "sample_logs") for folder in (Path(), ROOT))
    assert report.items() <= shipped.items()
    assert report.keys() >= {"aisle_uwb.ulg", "aisle_uwb.tlog", "loop_vio.ulg", "loop_slam.tum"}
    run_checked("sample")  # identical files may be overwritten


@pytest.mark.usefixtures("samples_installed")
def test_sample_command_does_not_overwrite_other_file() -> None:
    Path("flights").mkdir()
    Path("flights/loop_slam.tum").write_text("mine")
    said = error_line("sample", "-o", "flights")
    assert "loop_slam.tum already exists with different contents. Move that file" in said
    assert contents(Path("flights")) == {"loop_slam.tum": b"mine"}


def test_sample_command_without_package_advises_pip_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "px4fuse_samples", None)
    assert 'not installed. Run pip install "px4fuse[samples]".' in error_line("sample")


@pytest.mark.parametrize(("words", "loaded"), [("info", False), ("extract -o out", True)])
def test_commands_that_write_no_table_do_not_import_pyarrow(words, loaded, sample_log, tmp_path):
    """Run in a new process, as the modules are loaded in this one."""
    typed = [*words.split(), str(sample_log)]
    script = (
        f"import sys; sys.argv[1:] = {typed!r}\nfrom px4fuse.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print('pyarrow', bool(sys.modules.get('pyarrow')), 'dask' in sys.modules)"
    )
    command = [sys.executable, "-c", script]
    finished = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert finished.stdout.splitlines()[-1] == f"pyarrow {loaded} False"


def test_commands_on_windows_code_page_open_files_as_utf8(tmp_path: Path) -> None:
    """Use the Western code page of a Windows console and a locale with a decimal comma."""
    (tmp_path / "l.ulg").write_bytes(tiny_log(1))
    typed = [
        "compare l.ulg -o r.pdf", "extract l.ulg -o t", "explore l.ulg",
        "simulate --passes 1 -o s.ulg", "answers l.ulg -o a.toml", "grade --write-rubric r.toml",
    ]  # fmt: skip
    script = (
        "import warnings, sys\n"
        "warnings.filterwarnings('error', category=EncodingWarning, module='px4fuse')\n"
        f"from px4fuse.cli import main\nfor words in {typed!r}:\n"
        "    sys.argv[1:] = words.split()\n"
        "    try:\n        main()\n    except SystemExit as ended:\n        assert not ended.code\n"
    )
    console = {"PYTHONUTF8": "0", "LC_ALL": "de_DE.UTF-8", "PYTHONIOENCODING": "cp1252"}
    environment = {**os.environ, **console, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-X", "warn_default_encoding", "-c", script]
    finished = subprocess.run(
        command, capture_output=True, cwd=tmp_path, env=environment, check=False
    )
    assert finished.returncode == 0, finished.stderr.decode("cp1252")[-300:]
