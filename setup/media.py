"""Draws the pictures of the README again, with the programs that are built (`make media`).

Pages are drawn in a browser without a window; where there is none, those pictures stay as they are.
"""

import base64
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
MEDIA = ROOT / "docs" / "media"
CAUDATA = ROOT / "target" / "release" / "caudata"
BROWSERS = ["chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"]
# How long the browser may take to draw a picture worth keeping.
PATIENCE_S = 180

# What `caudata sim show` is told, by file.
DRAWN = {
    "walk.gif": "--policy policies/flat.onnx --view side --distance 1.7",
    "top.gif": "--policy policies/flat.onnx --view top --distance 1.7",
    "turn.gif": "--policy policies/amphibious.onnx --terrain deep_water --command 0.3,0,0.5 --view top --distance 2"
                " --width 320 --fps 5 --seconds 6 --settle-s 3",
    "swim.gif": "--policy policies/amphibious.onnx --terrain shore --place 2.6,0 --distance 2",
    "ashore.gif": "--policy policies/amphibious.onnx --terrain shore --place 2.6,0 --heading-deg 180 --distance 2"
                  " --width 320 --fps 5 --seconds 7 --settle-s 6",
    "quadruped.gif": "--robot robots/quadruped.robot.toml --policy policies/quadruped.onnx --command 0.6,0,0"
                     " --view side --distance 1.6",
    "biped.gif": "--robot robots/biped.robot.toml --policy policies/biped.onnx --command 0.15,0,0 --view side"
                 " --distance 1",
    "rough.png": "--policy policies/rough.onnx --terrain rough_hard --settle-s 6 --width 480",
}
ANIMATED = "--width 320 --fps 10 --seconds 2.4 --settle-s 3"


# A servo that swings a weight, with friction that its robot file does not have, and what is recorded of it.
RIG = "robots/xl330_pendulum.robot.toml"
HIDDEN = "lane.joint_friction_nm=0.03"
TRIALS = ["steps_medium", "chirp_medium", "triangle_creep", "multisine"]


class Browser:
    """A page in a browser, over its debugging pipe (descriptors 3 and 4)."""

    def __init__(self, program, width, height):
        self.home = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        command = [program, "--headless", "--no-sandbox", "--hide-scrollbars", "--disable-dev-shm-usage",
                   "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-pipe",
                   f"--window-size={width},{height}", f"--user-data-dir={self.home.name}", "about:blank"]
        shell = ["sh", "-c", 'exec "$@" 3<&0 4>&1 1>/dev/null 2>/dev/null', "sh", *command]
        self.process = subprocess.Popen(shell, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.session, self.calls = None, 0
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def call(self, method, **parameters):
        self.calls += 1
        call = {"id": self.calls, "method": method, "params": parameters}
        if self.session:
            call["sessionId"] = self.session
        self.process.stdin.write(json.dumps(call).encode() + b"\0")
        self.process.stdin.flush()
        while True:
            answer = bytearray()
            while not answer.endswith(b"\0"):
                byte = self.process.stdout.read(1)
                if not byte:
                    sys.exit("media: the browser has ended")
                answer += byte
            answer = json.loads(answer[:-1])
            if answer.get("id") == self.calls:
                if "error" in answer:
                    sys.exit(f"media: {method}: {answer['error']}")
                return answer.get("result", {})

    def value(self, expression):
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def until(self, expression):
        end = time.monotonic() + PATIENCE_S
        while not self.value(f"!!({expression})"):
            if time.monotonic() > end:
                sys.exit(f"media: never true on the page: {expression}")
            time.sleep(0.1)

    def end(self):
        self.process.kill()
        self.process.wait()
        self.home.cleanup()


def draw(name, flags):
    animated = ANIMATED.split() if name.endswith(".gif") and "--fps" not in flags else []
    caudata("sim", "show", "--out", MEDIA / name, *flags.split(), *animated)


def getting_up():
    """An episode that begins with a throw, of the policy that does everything."""
    with tempfile.TemporaryDirectory() as work:
        caudata("eval", "policies/everything.onnx", "--preset", "amphibious", "--suite", "righting", "--episodes", "1",
                "--seconds", "4", "--seed", "5", "--log", work)
        caudata("sim", "show", "--log", f"{work}/on_its_feet_again", "--out", MEDIA / "up.gif", "--view", "side",
                "--distance", "1.5", "--width", "320", "--fps", "8")


def caudata(*args):
    subprocess.run([CAUDATA, *args], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def shot(browser, name):
    picture = browser.call("Page.captureScreenshot", format="png")
    (MEDIA / name).write_bytes(base64.b64decode(picture["data"]))
    print(MEDIA / name)


def diagnosis(program):
    """Records the rig, has it diagnosed, and draws the head of the page."""
    with tempfile.TemporaryDirectory() as work:
        caudata("gap", "excite", "--robot", RIG, "--out", f"{work}/battery")
        for trial in TRIALS:
            caudata("sim", "rollout", "--robot", RIG, "--base", "fixed", "--commands", f"{work}/battery/{trial}.csv",
                    "--rate-hz", "100", "--set", HIDDEN, "--out", f"{work}/logs/{trial}/log.csv")
        caudata("gap", "diagnose", "--robot", RIG, "--log", f"{work}/logs", "--out", f"{work}/found")
        browser = Browser(program, 1000, 900)
        try:
            browser.call("Page.navigate", url=f"file://{work}/found/report.html")
            browser.until("document.querySelector('svg')")
            shot(browser, "diagnosis.png")
        finally:
            browser.end()


def live_page(program):
    played = subprocess.Popen([CAUDATA, "play", "policies/flat.onnx"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    browser = Browser(program, 1000, 735)
    try:
        address = played.stdout.readline().split()[-1]
        browser.call("Page.navigate", url=address)
        browser.until("caudata.live && caudata.live.film")
        browser.value("caudata.live.drive.go([0.3, 0, 0.2])")
        browser.until("caudata.live.film.frames > 550 && caudata.live.drawn > 20")
        shot(browser, "live.png")
    finally:
        browser.end()
        played.send_signal(signal.SIGINT)
        played.wait()


def main():
    for name, flags in DRAWN.items():
        draw(name, flags)
    getting_up()
    program = next((found for found in map(shutil.which, BROWSERS) if found), None)
    if program:
        diagnosis(program)
        live_page(program)
    else:
        print("media: the pictures of pages stay as they are: there is no Chromium here")
    for path in sorted(MEDIA.iterdir()):
        print(f"{os.path.getsize(path) / 1000:8.0f} kB  {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
