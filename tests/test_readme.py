"""The README's ten lines run as they stand there."""

import pathlib
import re

import warploom as wl

ROOT = pathlib.Path(__file__).resolve().parent.parent


def test_the_ten_lines_of_python_run_as_they_stand(tmp_path, monkeypatch, capsys):
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    (tmp_path / "my_scans").mkdir()
    for frame in wl.read("sim:street?seed=1&duration=0.2"):
        frame.points.tofile(tmp_path / "my_scans" / f"{frame.index:06d}.bin")
    (tmp_path / "000000.bin").write_bytes((tmp_path / "my_scans" / "000000.bin").read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(compile(code[1], "README.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_the_files_that_the_readme_links_are_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if not link.startswith("http")]
    assert links
    assert not [link for link in links if not (ROOT / link).exists()]
