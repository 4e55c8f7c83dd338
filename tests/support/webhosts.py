"""Web servers as other people run them, on a free loopback port, with the very recipes that `doctor` prints."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pointstream.remedies import APACHE, CADDY, NGINX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SYSTEM_PATH = "/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/bin"
APACHE_MODULES = Path("/usr/lib/apache2/modules")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def nginx(models: Path, folder: Path, port: int, *, recipe: bool) -> list[str]:
    location = NGINX.replace("/srv/models", str(models)) if recipe else f"root {models};"
    temporary = "\n".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"pid {folder}/pid; daemon off; master_process off; error_log stderr;\nevents {{ }}\n"
        f"http {{ access_log off; {temporary}\nserver {{ listen 127.0.0.1:{port};\n{location}\n}} }}\n"
    )
    return [_program("nginx"), "-p", str(folder), "-c", str(folder / "nginx.conf"), "-e", "stderr"]


def apache(models: Path, folder: Path, port: int, *, recipe: bool) -> list[str]:
    modules = ["mpm_event", "authz_core", "mime", "headers", "setenvif", "deflate", "filter"]
    load = "\n".join(f"LoadModule {name}_module {APACHE_MODULES}/mod_{name}.so" for name in modules)
    lines = APACHE if recipe else "<Directory /srv/models>\nRequire all granted\n</Directory>"
    (folder / "mime.types").write_text("")
    (folder / "apache.conf").write_text(
        f"{load}\nServerRoot {folder}\nServerName test\nListen 127.0.0.1:{port}\nPidFile {folder}/pid\n"
        f"DefaultRuntimeDir {folder}\nErrorLog {folder}/error.log\nTypesConfig {folder}/mime.types\nStartServers 1\n"
        f"DocumentRoot {models}\nSetOutputFilter DEFLATE\n" + lines.replace("/srv/models", str(models)) + "\n"
    )
    return [_program("apache2"), "-X", "-f", str(folder / "apache.conf")]


def caddy(models: Path, folder: Path, port: int, *, recipe: bool) -> list[str]:
    lines = CADDY.replace("/srv/models", str(models)) if recipe else f"root * {models}\nfile_server\nencode gzip"
    (folder / "Caddyfile").write_text(
        f"{{\nadmin off\nauto_https off\nstorage file_system {folder}\n}}\nhttp://127.0.0.1:{port} {{\n{lines}\n}}\n"
    )
    return [_program("caddy"), "run", "--adapter", "caddyfile", "--config", str(folder / "Caddyfile")]


def lighttpd(models: Path, folder: Path, port: int, *, recipe: bool) -> list[str]:
    (folder / "lighttpd.conf").write_text(
        f'server.document-root = "{models}"\nserver.bind = "127.0.0.1"\nserver.port = {port}\n'
        f'server.pid-file = "{folder}/pid"\nserver.errorlog = "{folder}/error.log"\n'
    )
    return [_program("lighttpd"), "-D", "-f", str(folder / "lighttpd.conf")]


def python(models: Path, folder: Path, port: int, *, recipe: bool) -> list[str]:
    return [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1", "--directory", str(models)]


HOSTS: dict[str, Callable[..., list[str]]] = {
    "nginx": nginx, "apache2": apache, "caddy": caddy, "lighttpd": lighttpd, "http.server": python,
}  # fmt: skip


def installed(name: str) -> bool:
    return name == "http.server" or shutil.which(name, path=SYSTEM_PATH) is not None


def _program(name: str) -> str:
    found = shutil.which(name, path=SYSTEM_PATH)
    assert found is not None
    return found


@contextmanager
def web_host(name: str, models: Path, folder: Path, *, recipe: bool = True) -> Iterator[str]:
    """Run a web server over a folder of models; gives its URL. Without its recipe it runs as it comes."""
    folder.mkdir(parents=True)
    for place in (models, *models.parents):
        if place.owner() == Path(folder).owner() and place.is_relative_to(folder.parents[1]):
            place.chmod(0o755)  # servers started by root read as somebody else
    port = free_port()
    log = folder / "output"
    with log.open("wb") as output:
        process = subprocess.Popen(
            HOSTS[name](models, folder, port, recipe=recipe),
            stdout=output, stderr=output, env={**os.environ, "HOME": str(folder)},
        )  # fmt: skip
    try:
        _wait_for(port, process, log)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(20)


def _wait_for(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + 20
    while process.poll() is None and time.monotonic() < deadline:
        with socket.socket() as sock:
            if sock.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.01)
    raise RuntimeError(f"it did not start: {log.read_text()}")
