"""The page's own certificate, and what `ibrobot doctor` says about it."""

from __future__ import annotations

from pathlib import Path

import pytest
import segno
from ibrobot_http.certificates import own_certificate
from ibrobot_webxr.certificate import checks, open_port
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.shared import qr_code

from ibrobot_core.api import TeleopError

NAMES = ("robot.lab", "192.168.1.5", "localhost")


def test_folder_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "ibrobot").write_text("")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with pytest.raises(TeleopError, match=r"ibrobot.*: (Not a directory|File exists)"):
        open_port(WebxrOptions(port=0))


def test_doctor_checks_the_certificate_and_its_key(tmp_path: Path):
    (check,) = checks(tmp_path)
    assert check.ok
    assert "none yet" in check.found
    certificate, key = own_certificate(tmp_path, NAMES)
    assert [check.ok for check in checks(tmp_path)] == [True, True]
    key.chmod(0o644)
    found = list(checks(tmp_path))
    assert (found[1].ok, found[1].remedy) == (False, f"chmod 600 {key}")
    certificate.write_text("?")
    (check,) = checks(tmp_path)
    assert not check.ok
    assert check.remedy.startswith(f"remove {tmp_path}")


def test_the_qr_code_has_the_modules_of_its_text():
    text = "https://192.168.1.5:8443/?token=0123456789abcdef"
    lines = qr_code(text).splitlines()
    modules = [list(row) for row in segno.make(text, error="l").matrix_iter(border=2)]
    assert len({len(line) for line in lines}) == 1
    for i, row in enumerate(modules):
        for j, dark in enumerate(row):
            light = lines[i // 2][j] in ("█▀" if i % 2 == 0 else "█▄")
            assert light != bool(dark)
