"""Tests of set-up against a small package index on 127.0.0.1 that misbehaves on request."""

import contextlib
import errno
import hashlib
import http.server
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest
import zipfile
from unittest import mock

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, HERE)

import download
import index
import parts
import pins
import provision
import python_env

# Runs provision.py in a process of its own, with the pins that the test hands over.
CHILD = """
import json, os, sys
sys.path.insert(0, os.environ["TEST_SETUP_DIR"])
import download, parts, pins, provision
def part(d):
    wheels = tuple(pins.Wheel(**dict(w, members=tuple(map(tuple, w["members"])))) for w in d["wheels"])
    return pins.Part(**dict(d, wheels=wheels, texts=tuple(map(tuple, d["texts"])), libraries=tuple(d["libraries"])))
fake = json.loads(os.environ["TEST_PINS"])
pins.LIBTORCH = {m: part(fake[0]) for m in pins.LIBTORCH}
pins.ONNXRUNTIME = {m: part(fake[1]) for m in pins.ONNXRUNTIME}
parts._check_loads = lambda part, folder: None
download.DEFAULT_RETRY = download.Retry(fruitless_max=2, first_wait_secs=0.01)
sys.exit(provision.main(sys.argv[1:]))
"""


def make_wheel(project, members):
    """The bytes of a wheel; stored, so that its size is under the test's control."""
    info = project.replace("-", "_") + "-1.0.dist-info/"  # `pip download` wants these two
    members[info + "METADATA"] = "Metadata-Version: 2.1\nName: %s\nVersion: 1.0\n" % project
    members[info + "WHEEL"] = "Wheel-Version: 1.0\nTag: cp311-cp311-manylinux_2_28_x86_64\n"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, body in members.items():
            archive.writestr(zipfile.ZipInfo(name), body)
    return buffer.getvalue()


def make_part(name, project, body, members, texts=()):
    filename = "%s-1.0-cp311-cp311-manylinux_2_28_x86_64.whl" % project.replace("-", "_")
    sha256 = hashlib.sha256(body).hexdigest()
    wheel = pins.Wheel(project, "1.0", filename, sha256, len(body), tuple(members))
    libraries = tuple(target for _, target in members if not target.endswith("/"))
    return pins.Part(name, "%s-1.0" % project, (wheel,), tuple(texts), 1000, libraries, libraries[0])


class FakeIndex(http.server.ThreadingHTTPServer):
    """A package index: `files` by name, faults by attribute, and a record of the requests for files."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), FakeIndexHandler)
        self.files = {}
        self.as_json = False
        self.break_after = None  # bytes after which a file's connection closes
        self.stall_after = None  # bytes after which a file's connection hangs
        self.honour_range = True
        self.refuse_agent = None
        self.pages = []
        self.ranges = []  # the Range header, or None, of each request for a file
        self.released = threading.Event()
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    @property
    def url(self):
        return "http://127.0.0.1:%d/simple" % self.server_address[1]

    def handle_error(self, request, client_address):
        pass  # clients that are killed are part of the tests

    def close(self):
        self.released.set()
        self.shutdown()
        self.server_close()


class FakeIndexHandler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def do_GET(self):
        if self.server.refuse_agent and self.server.refuse_agent in self.headers.get("User-Agent", ""):
            self.send_error(403)
        elif self.path.startswith("/simple/"):
            self.send_page(self.path.split("/")[2])
        else:
            self.send_file(self.server.files.get(self.path.rsplit("/", 1)[-1]))

    def send_page(self, project):
        self.server.pages.append(project)
        names = [name for name in self.server.files if name.startswith(project.replace("-", "_") + "-")]
        if self.server.as_json:
            kind = "application/vnd.pypi.simple.v1+json"
            files = [{"filename": n, "url": "../../files/" + n, "hashes": {}} for n in names]
            body = json.dumps({"meta": {"api-version": "1.0"}, "name": project, "files": files})
        else:
            kind = "text/html"
            body = "".join('<a href="/files/%s">%s</a>' % (n, n) for n in names)
            body = "<!DOCTYPE html><html><body>%s</body></html>" % body
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body.encode())

    def send_file(self, body):
        asked = self.headers.get("Range")
        self.server.ranges.append(asked)
        if body is None:
            self.send_error(404)
            return
        start = 0
        if asked and self.server.honour_range:
            start = int(re.match(r"bytes=(\d+)-", asked).group(1))
            if start >= len(body):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", "bytes %d-%d/%d" % (start, len(body) - 1, len(body)))
        else:
            self.send_response(200)
        rest = body[start:]
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        if self.server.stall_after is not None:
            self.wfile.write(rest[: self.server.stall_after])
            self.server.released.wait(20)
        elif self.server.break_after is not None:
            self.wfile.write(rest[: self.server.break_after])
        else:
            self.wfile.write(rest)


class ProvisionCase(unittest.TestCase):
    def setUp(self):
        self.root = tempfile.mkdtemp()
        self.addCleanup(shutil.rmtree, self.root, ignore_errors=True)
        self.index = FakeIndex()
        self.addCleanup(self.index.close)
        self.checkout = os.path.join(self.root, "checkout")
        os.mkdir(self.checkout)
        self.cache = os.path.join(self.root, "cache", "caudata")
        self.torch_body = make_wheel(
            "fake-torch",
            {"torch/lib/libtorch_cpu.so": os.urandom(300_000), "torch/include/a/b.h": "//", "torch/big.so": "unwanted"},
        )
        members = [("torch/lib/libtorch_cpu.so", "lib/libtorch_cpu.so"), ("torch/include/", "include/")]
        self.torch = make_part("libtorch", "fake-torch", self.torch_body, members, [("lib/libtorch.so", "INPUT(-x)\n")])
        ort_body = make_wheel("fake-ort", {"ort/lib.so.1": "ort"})
        self.ort = make_part("ONNX Runtime", "fake-ort", ort_body, [("ort/lib.so.1", "lib/libonnxruntime.so")])
        self.index.files = {self.wheel.filename: self.torch_body, self.ort.wheels[0].filename: ort_body}
        self.patch_environment()
        self.patch(pins, "LIBTORCH", dict.fromkeys(pins.LIBTORCH, self.torch))
        self.patch(pins, "ONNXRUNTIME", dict.fromkeys(pins.ONNXRUNTIME, self.ort))
        # Asking the real pip takes a second; the tests that want it call `ask_the_real_pip`.
        self.real_pip_settings = index.pip_settings
        self.patch(index, "pip_settings", lambda: self.settings(os.environ["PIP_INDEX_URL"]))
        self.patch(parts, "_check_loads", lambda part, folder: None)
        self.patch(download, "DEFAULT_RETRY", download.Retry(fruitless_max=2, first_wait_secs=0.01))

    @staticmethod
    def settings(index_url):
        return index.PipSettings((index_url,), None, None, None, None, (), 10.0)

    def ask_the_real_pip(self):
        self.real_pip_settings.cache_clear()
        self.patch(index, "pip_settings", self.real_pip_settings)

    def patch_environment(self):
        environment = {k: v for k, v in os.environ.items() if not k.upper().startswith(("PIP_", "LIBTORCH", "CAUDATA_"))}
        environment.pop("ORT_DYLIB_PATH", None)
        environment.update(
            XDG_CACHE_HOME=os.path.join(self.root, "cache"),
            HOME=self.root,
            PIP_CONFIG_FILE=os.devnull,
            PIP_INDEX_URL=self.index.url,
            PIP_RETRIES="0",
            PIP_DISABLE_PIP_VERSION_CHECK="1",
            NO_PROXY="*",
        )
        patcher = mock.patch.dict(os.environ, environment, clear=True)
        patcher.start()
        self.addCleanup(patcher.stop)

    def patch(self, target, name, value):
        patcher = mock.patch.object(target, name, value)
        patcher.start()
        self.addCleanup(patcher.stop)

    @property
    def wheel(self):
        return self.torch.wheels[0]

    @property
    def torch_folder(self):
        return os.path.join(self.cache, self.torch.folder)

    @property
    def part_file(self):
        return os.path.join(self.cache, "downloads", self.wheel.filename + ".part")

    def run_setup(self, *arguments):
        """Exit status, standard output and standard error of one run in this process."""
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = provision.main(["--checkout", self.checkout] + list(arguments))
        return code, out.getvalue(), err.getvalue()

    def start_child(self):
        """The same in a process of its own."""
        fake = json.dumps([dict(p._asdict(), wheels=[w._asdict() for w in p.wheels]) for p in (self.torch, self.ort)])
        environment = dict(os.environ, TEST_SETUP_DIR=HERE, TEST_PINS=fake)
        command = [sys.executable, "-c", CHILD, "--checkout", self.checkout]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    def assert_one_error(self, err, *words):
        errors = [line for line in err.splitlines() if line.startswith("setup: error: ")]
        self.assertEqual(1, len(errors), err)
        self.assertNotIn("Traceback", err)
        for word in words:
            self.assertIn(word, errors[0])

    def keep_part(self, body):
        os.makedirs(os.path.dirname(self.part_file))
        with open(self.part_file, "wb") as file:
            file.write(body)


class FreshMachine(ProvisionCase):
    def test_unpacks_what_is_needed_and_nothing_else(self):
        code, out, err = self.run_setup("--print-env")
        self.assertEqual(0, code, err)
        found = {
            os.path.relpath(os.path.join(here, name), self.torch_folder)
            for here, _, names in os.walk(self.torch_folder)
            for name in names
        }
        self.assertEqual({"lib/libtorch_cpu.so", "lib/libtorch.so", "include/a/b.h", "stamp.json"}, found)
        self.assertEqual([], os.listdir(os.path.join(self.cache, "downloads")))
        library = os.path.join(self.cache, self.ort.folder, "lib", "libonnxruntime.so")
        lines = "export LIBTORCH=%s\nexport ORT_DYLIB_PATH=%s\nexport PYO3_NO_PYTHON=1\n"
        self.assertEqual(lines % (self.torch_folder, library), out)
        with open(os.path.join(self.checkout, ".cargo", "config.toml")) as file:
            self.assertIn('LIBTORCH = "%s"\n' % self.torch_folder, file.read())

    def test_second_run_asks_nobody(self):
        self.run_setup()
        self.index.pages.clear()
        code, _, err = self.run_setup()
        self.assertEqual((0, "", []), (code, err, self.index.pages))

    def test_exports_of_an_earlier_run_are_not_a_users_path(self):
        self.run_setup()
        shutil.rmtree(self.torch_folder)
        with mock.patch.dict(os.environ, LIBTORCH=self.torch_folder):
            self.assertEqual(0, self.run_setup()[0])
        self.assertTrue(os.path.exists(self.torch_folder))

    def test_damaged_folder_is_made_again(self):
        self.run_setup()
        os.remove(os.path.join(self.torch_folder, "include", "a", "b.h"))
        self.assertEqual(0, self.run_setup()[0])
        self.assertTrue(parts.is_intact(self.torch, self.torch_folder, verify=True))

    def test_verify_finds_a_changed_byte(self):
        self.run_setup()
        with open(os.path.join(self.torch_folder, "lib", "libtorch_cpu.so"), "r+b") as file:
            file.write(b"changed")
        self.assertTrue(parts.is_intact(self.torch, self.torch_folder))
        self.assertEqual(0, self.run_setup("--verify")[0])
        self.assertTrue(parts.is_intact(self.torch, self.torch_folder, verify=True))

    def test_json_index(self):
        self.index.as_json = True
        self.ask_the_real_pip()
        self.assertEqual(0, self.run_setup()[0])

    def test_users_cargo_config_stays(self):
        path = os.path.join(self.checkout, ".cargo", "config.toml")
        os.mkdir(os.path.dirname(path))
        with open(path, "w") as file:
            file.write("[build]\njobs = 1\n")
        code, _, err = self.run_setup()
        self.assertEqual(0, code)
        self.assertIn("is your own and stays as it is", err)
        with open(path) as file:
            self.assertEqual("[build]\njobs = 1\n", file.read())


class BrokenDownload(ProvisionCase):
    def test_break_is_continued(self):
        self.index.break_after = 120_000
        code, _, err = self.run_setup()
        self.assertEqual(0, code, err)
        # 300 kB in pieces of 120 kB: two breaks, two continuations, and the other wheel in one go.
        self.assertEqual([None, "bytes=120000-", "bytes=240000-", None], self.index.ranges)

    def test_killed_run_is_continued(self):
        self.index.stall_after = 100_000
        child = self.start_child()
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline and download._size(self.part_file) == 0:
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stderr.close()
        self.index.stall_after = None
        have = download._size(self.part_file)
        self.assertGreater(have, 0)
        self.index.ranges.clear()
        self.assertEqual(0, self.run_setup()[0])
        self.assertEqual("bytes=%d-" % have, self.index.ranges[0])

    def test_leftovers_of_a_killed_run_are_removed(self):
        os.makedirs(self.torch_folder + ".tmp-12345")
        self.assertEqual(0, self.run_setup()[0])
        self.assertFalse(os.path.exists(self.torch_folder + ".tmp-12345"))

    def test_server_that_cannot_continue(self):
        self.keep_part(self.torch_body[:1000])
        self.index.honour_range = False
        code, _, err = self.run_setup()
        self.assertEqual(0, code, err)
        self.assertIn("starts from zero", err)

    def test_wrong_hash_is_thrown_away(self):
        self.index.files[self.wheel.filename] = self.torch_body[:-1] + b"x"
        code, _, err = self.run_setup()
        self.assertEqual(11, code, err)
        self.assert_one_error(err, "fake-torch 1.0", "pinned hash")
        self.assertEqual([], os.listdir(os.path.join(self.cache, "downloads")))

    def test_damaged_piece_is_thrown_away_and_loaded_again(self):
        self.keep_part(b"?" * 1000)
        code, _, err = self.run_setup()
        self.assertEqual(0, code, err)
        self.assertIn("thrown away", err)
        self.assertEqual(["bytes=1000-", None], self.index.ranges[:2])

    def test_piece_longer_than_the_file(self):
        self.keep_part(b"?" * (self.wheel.size + 5))
        self.assertEqual(0, self.run_setup()[0])

    def test_pip_stands_in_when_the_index_refuses_us(self):
        self.index.refuse_agent = "caudata-setup"
        code, _, err = self.run_setup()
        self.assertEqual(0, code, err)
        self.assertIn("trying `pip download`", err)

    def test_no_network(self):
        os.environ["PIP_INDEX_URL"] = "http://127.0.0.1:9/simple"
        code, _, err = self.run_setup()
        self.assertEqual(10, code, err)
        self.assert_one_error(err, "fake-torch 1.0", "check the network")

    def test_password_stays_out_of_messages(self):
        os.environ["PIP_INDEX_URL"] = "http://user:secret@127.0.0.1:9/simple"
        self.assertNotIn("secret", self.run_setup()[2])


class FullDisk(ProvisionCase):
    def test_refused_before_the_download(self):
        usage = shutil.disk_usage(self.root)._replace(free=1_000_000)
        with mock.patch.object(shutil, "disk_usage", return_value=usage):
            code, _, err = self.run_setup()
        self.assertEqual(12, code, err)
        self.assert_one_error(err, "needs 50 MB", "1 MB is free", "XDG_CACHE_HOME")
        self.assertEqual([], self.index.ranges)

    def test_full_during_the_download(self):
        with mock.patch.object(download, "_copy", side_effect=OSError(errno.ENOSPC, "full")):
            code, _, err = self.run_setup()
        self.assertEqual(12, code, err)
        self.assert_one_error(err, "no space left", "XDG_CACHE_HOME")

    def test_full_during_unpacking(self):
        with mock.patch.object(parts, "_extract", side_effect=OSError(errno.ENOSPC, "full")):
            code, _, err = self.run_setup()
        self.assertEqual(12, code, err)
        self.assertFalse([name for name in os.listdir(self.cache) if ".tmp" in name])


class UsersPaths(ProvisionCase):
    def users_libtorch(self, version):
        folder = os.path.join(self.root, "mine")
        files = {"build-version": version, "include/torch/csrc/api/include/torch/torch.h": ""}
        files.update({"lib/" + so: "" for so in ("libtorch.so", "libtorch_cpu.so", "libc10.so")})
        for path, text in files.items():
            os.makedirs(os.path.dirname(os.path.join(folder, path)), exist_ok=True)
            with open(os.path.join(folder, path), "w") as file:
                file.write(text)
        os.environ["LIBTORCH"] = folder
        return folder

    def test_users_libtorch_is_used(self):
        folder = self.users_libtorch(pins.LIBTORCH_VERSION + "+cu130")
        code, out, err = self.run_setup("--print-env")
        self.assertEqual(0, code, err)
        self.assertIn("export LIBTORCH=%s\n" % folder, out)
        self.assertNotIn("fake-torch", self.index.pages)
        self.assertFalse(os.path.exists(self.torch_folder))

    def test_users_libtorch_of_another_version(self):
        self.users_libtorch("2.1.0")
        code, _, err = self.run_setup()
        self.assertEqual(13, code)
        self.assert_one_error(err, "is version 2.1.0", "LIBTORCH_BYPASS_VERSION_CHECK=1")

    def test_users_libtorch_lacks_a_file(self):
        os.remove(os.path.join(self.users_libtorch(pins.LIBTORCH_VERSION), "lib", "libc10.so"))
        code, _, err = self.run_setup()
        self.assertEqual(13, code)
        self.assert_one_error(err, "LIBTORCH=", "lacks lib/libc10.so")
        self.assertEqual([], self.index.pages)

    def test_users_onnxruntime_is_not_there(self):
        os.environ["ORT_DYLIB_PATH"] = "/nowhere/libonnxruntime.so"
        code, _, err = self.run_setup()
        self.assertEqual(13, code)
        self.assert_one_error(err, "ORT_DYLIB_PATH=/nowhere/libonnxruntime.so is not a file")

    def test_users_onnxruntime_is_no_library(self):
        os.environ["ORT_DYLIB_PATH"] = os.path.abspath(__file__)
        code, _, err = self.run_setup()
        self.assertEqual(13, code)
        self.assert_one_error(err, "cannot be used")


class TwoRunsAtOnce(ProvisionCase):
    def test_each_file_is_downloaded_once(self):
        children = [self.start_child() for _ in range(2)]
        messages = [child.communicate(timeout=20)[1].decode() for child in children]
        self.assertEqual([0, 0], [child.returncode for child in children], messages)
        self.assertEqual(2, len(self.index.ranges), messages)
        self.assertTrue(parts.is_intact(self.torch, self.torch_folder, verify=True))


class MujocoOptional(ProvisionCase):
    def test_skipped_where_no_wheel_fits(self):
        requirements = os.path.join(self.root, "requirements.txt")
        with open(requirements, "w") as file:
            file.write("mujoco==0.0.1 --hash=sha256:%s\n" % ("0" * 64))
        err = io.StringIO()
        with contextlib.redirect_stderr(err):
            self.assertIsNone(python_env.provision(python_env.MUJOCO._replace(requirements=requirements)))
        self.assertIn("mujoco: skipped", err.getvalue())
        self.assertIn("No matching distribution", err.getvalue())


class PipConfiguration(unittest.TestCase):
    def test_environment_wins_over_files(self):
        listed = "global.index-url='http://a/simple'\n:env:.index-url='http://b/simple'\nglobal.cert='/c.pem'\n"
        self.assertEqual({"index-url": "http://b/simple", "cert": "/c.pem"}, index.parse_pip_config(listed))

    def test_download_section_wins_over_global_and_others_do_not_count(self):
        listed = "download.proxy='p'\nglobal.proxy='q'\ninstall.index-url='http://i'\n"
        self.assertEqual({"proxy": "p"}, index.parse_pip_config(listed))

    def test_no_index_switched_off(self):
        self.assertEqual({}, index.parse_pip_config("global.no-index='false'\n"))

    def test_links_of_a_page_with_a_base(self):
        page = b'<base href="http://files/x/"><a href="y/a%2B1.whl#sha256=ab">a</a>'
        expected = {"a+1.whl": index.Link("http://files/x/y/a%2B1.whl", "ab")}
        self.assertEqual(expected, index.links_from_html(page, "http://index/simple/a/"))

    def test_credentials_travel_in_a_header(self):
        plain, header = index.split_credentials("https://me:p%40ss@host:8/simple")
        self.assertEqual(("https://host:8/simple", "Basic bWU6cEBzcw=="), (plain, header))


class Tidy(unittest.TestCase):
    def test_no_index_address_in_the_code(self):
        for name in os.listdir(HERE):
            if name.endswith((".py", ".txt")) and name != os.path.basename(__file__):
                with open(os.path.join(HERE, name)) as file:
                    self.assertIsNone(re.search(r"https?://\w", file.read()), name)

    def test_pins_are_complete(self):
        for part in list(pins.LIBTORCH.values()) + list(pins.ONNXRUNTIME.values()):
            for wheel in part.wheels:
                self.assertRegex(wheel.sha256, r"^[0-9a-f]{64}$")
                self.assertIn(wheel.version, wheel.filename)
                self.assertGreater(wheel.size, 0)

    def test_onnxruntime_level_agrees_with_cargo(self):
        path = os.path.join(os.path.dirname(HERE), "Cargo.toml")
        with open(path) as file:
            ort = re.search(r"^ort = .*$", file.read(), re.MULTILINE)
        if not ort:
            self.skipTest("%s has no line `ort = ...`" % path)
        levels = [int(level) for level in re.findall(r'"api-(\d+)"', ort.group(0))]
        self.assertEqual(max(levels, default=17), pins.ONNXRUNTIME_MIN_MINOR)

    def test_versions_agree_with_the_requirements(self):
        for wanted, package in (
            (python_env.MUJOCO, "mujoco"), (python_env.RECORDINGS, "pyarrow"), (python_env.ROS2, "ros-rclpy")
        ):
            with open(wanted.requirements) as file:
                self.assertIn("%s==%s " % (package, wanted.version), file.read())


if __name__ == "__main__":
    unittest.main()
