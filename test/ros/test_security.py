"""What SECURITY.md says of ports and rights."""

import os
import stat
from pathlib import Path

import pytest

from pnv_core.files import atomic_write
from test.maps.worlds import saved
from test.ros.processes import Process, running_node
from test.tally import tally


def sockets(node: Process, kind: str) -> list[str]:
    """The local addresses (hexadecimal, address:port) of a process's sockets of /proc/net/`kind`."""
    folder = Path(f"/proc/{node.child.pid}/fd")
    held = {os.readlink(entry) for entry in folder.iterdir() if entry.exists() or entry.is_symlink()}
    rows = [line.split() for line in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]]
    return [row[1] for row in rows if f"socket:[{row[9]}]" in held]


@pytest.mark.process
def test_the_node_opens_no_port_but_those_of_dds(domain, listener):
    first = 7400 + 250 * domain
    with running_node() as node:
        assert sockets(node, "tcp") + sockets(node, "tcp6") == []
        udp = [entry.rsplit(":", 1) for kind in ("udp", "udp6") for entry in sockets(node, kind)]
        assert any(first <= int(port, 16) < first + 250 for _, port in udp)
        assert node.end() == 0
    tally("11 nodes that open UDP ports of DDS and no other", 1, 1)


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_what_is_written_has_the_rights_of_the_umask(tmp_path, umask, monkeypatch):
    before = os.umask(umask)
    try:
        with monkeypatch.context() as patch:
            patch.delattr(os, "umask")  # to change it, if only to read it, would change it for other threads
            saved(tmp_path / "map", 20)
            with atomic_write(tmp_path / "file") as file:
                file.write(b"x")
    finally:
        os.umask(before)
    written = [tmp_path / "map", tmp_path / "file", *(tmp_path / "map").iterdir()]
    for path in written:
        whole = 0o777 if path.is_dir() else 0o666
        assert stat.S_IMODE(path.stat().st_mode) == whole & ~umask, path
    tally("11 files and folders with the rights of the umask", len(written), len(written))
