"""The programs, policies and logs of the package."""

import contextlib
import fcntl
import io
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import unittest
from unittest import mock

import caudata
import numpy as np

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


def example(name, *arguments):
    done = subprocess.run([sys.executable, str(EXAMPLES / name), *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise AssertionError("%s: %s" % (name, done.stderr))
    return done.stdout


def needs(*modules):
    missing = []
    for module in modules:
        try:
            __import__(module)
        except ImportError:
            missing.append(module)
    return unittest.skipIf(missing, "not installed: " + ", ".join(missing))


ROS_TOPICS = {"/joint_states", "/joint_commands", "/imu/data", "/tf", "/odom", "/base/pose"}


def walk(folder):
    """A robot that stands in the simulation, as an MCAP file."""
    commands, out = os.path.join(folder, "commands.csv"), os.path.join(folder, "stand.mcap")
    with open(commands, "w") as file:
        file.write("t,cmd.FL_hip\n0,0\n0.5,0.1\n1,0\n")
    csv = os.path.join(folder, "stand.csv")
    robot = caudata.robot_path("polymander")
    caudata.run("sim", "rollout", "--robot", robot, "--commands", commands, "--out", csv, quiet=True)
    caudata.run("log", "convert", csv, "--out", out, "--robot", robot)
    return out


def mcap_summary(file):
    """By topic: the message's type, and every message as the `mcap` package decodes it."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as missing:
        raise unittest.SkipTest(str(missing))
    out = {}
    for schema, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
        out.setdefault(channel.topic, (schema.name, []))[1].append(message)
    return out


class Package(unittest.TestCase):
    def test_robots_policies_and_presets_are_in_the_package(self):
        self.assertIn("polymander", caudata.robots())
        self.assertLessEqual({"flat", "rough", "amphibious"}, set(caudata.policies()))
        self.assertIn("quick", caudata.presets())

    def test_a_policy_walks(self):
        envs = caudata.make_vec("polymander", "flat", 16, seed=2, signals=True)
        policy = caudata.Policy("flat")
        policy.check(envs)
        with self.assertRaisesRegex(ValueError, "takes observations .*, not .3, 5."):
            policy(np.zeros((3, 5)))
        observations, _ = envs.reset(options={"command": (0.3, 0.0, 0.0)})
        speeds = []
        for _ in range(250):
            observations, _, _, _, _ = envs.step(policy(observations))
            speeds.append(envs.signals.com_vel_mps[:, 0].mean())
        self.assertAlmostEqual(float(np.mean(speeds[100:])), 0.3, delta=0.06)

    def test_a_policy_of_ones_own_goes_into_every_program(self):
        envs = caudata.make_vec("quadruped", num_envs=4, seed=1)
        sizes, random = (envs.single_observation_space.shape[0], 6, 12), np.random.default_rng(2)
        layers = [
            (random.normal(0, 0.1, (out, size)).astype(np.float32), np.full(out, 0.01, np.float32))
            for size, out in zip(sizes, sizes[1:])
        ]
        mean, std = random.normal(0, 1, sizes[0]), random.uniform(0.5, 2, sizes[0])
        observations = envs.reset()[0]
        with tempfile.TemporaryDirectory() as folder:
            path = caudata.write_policy(
                os.path.join(folder, "mine", "policy.onnx"), envs, layers,
                activation="tanh", obs_mean=mean, obs_std=std, obs_clip=2.0, env_steps=7,
            )  # fmt: skip
            policy = caudata.Policy(path)
            policy.check(envs)
            self.assertEqual(policy.metadata["env_steps"], 7)
            scaled = np.clip((observations - mean) / std, -2, 2)
            hidden = np.tanh(scaled @ layers[0][0].T + 0.01)
            np.testing.assert_allclose(policy(observations), hidden @ layers[1][0].T + 0.01, atol=1e-5)
            # The task is found beside the file.
            self.assertFalse(caudata.evaluate(path, episodes=1, seconds=4).walks)
            with self.assertRaisesRegex(ValueError, "gelu"):
                caudata.write_policy(path, envs, layers, activation="gelu")
            with self.assertRaisesRegex(ValueError, "layer inputs"):
                caudata.write_policy(path, envs, layers[1:], activation="elu")
            # Settings that lie there stay.
            config = path.with_name("config.toml")
            config.write_text("[run]\nseed = 3\n")
            with self.assertWarnsRegex(UserWarning, "they are in config.1.toml now"):
                caudata.write_policy(path, envs, layers, activation="tanh")
            self.assertEqual(path.with_name("config.1.toml").read_text(), "[run]\nseed = 3\n")
            self.assertEqual(config.read_text(encoding="utf-8"), envs.configuration)
            # Those of a training are its own.
            path.with_name("run_id.txt").write_text("walk")
            with self.assertRaisesRegex(ValueError, "folder of a training"):
                caudata.write_policy(path, envs, layers, activation="tanh")

    def test_the_benchmark_measures(self):
        from caudata import bench

        rates = bench.measure(8, 0.2)
        self.assertLessEqual({"caudata", "caudata in Rust"}, set(rates))
        self.assertTrue(all(rate > 10 for rate in rates.values()), rates)

    def test_a_folder_for_a_hub_is_used_elsewhere_as_it_is(self):
        from caudata import hub

        with tempfile.TemporaryDirectory() as scratch:
            folder = hub.export(caudata.policy_path("quadruped"), pathlib.Path(scratch, "walk"), "quadruped")
            found = caudata.evaluate(folder / "policy.onnx", robot=folder / "robot/quadruped.robot.toml", episodes=2)
            self.assertIn(found.policy_sha256, (folder / "README.md").read_text())
            self.assertTrue((folder / "walk.gif").read_bytes().startswith(b"GIF89a"))
            with self.assertRaises(FileExistsError):
                hub.export(caudata.policy_path("quadruped"), folder, "quadruped")

    def test_a_folder_for_a_hub_has_all_that_an_imported_robot_and_its_ground_need(self):
        from caudata import hub

        box = [(x, y, z) for x in (-0.19, 0.19) for y in (-0.05, 0.05) for z in (-0.06, 0.06)]
        sides = "124 143 578 586 156 162 348 387 137 175 268 284".split()
        lines = ["v %g %g %g" % corner for corner in box] + ["f " + " ".join(side) for side in sides]
        shipped = caudata.robot_path("quadruped").with_name("quadruped.xml").read_text()
        trunk = 'name="trunk_box" type="box" size="0.1881 0.0468 0.057"'
        self.assertIn(trunk, shipped)
        meshed = shipped.replace(trunk, 'name="trunk_box" type="mesh" mesh="trunk"')
        meshed = meshed.replace("<worldbody>", '<asset><mesh name="trunk" file="trunk.obj"/></asset><worldbody>')
        with tempfile.TemporaryDirectory() as scratch:
            here = pathlib.Path(scratch, "here")
            here.mkdir()
            (here / "trunk.obj").write_text("\n".join(lines) + "\n")
            (here / "dog.xml").write_text(meshed)
            (here / "hills.csv").write_text("0,0,0\n0,1,0\n0,0,0\n")
            caudata.run("robot", "import", here / "dog.xml", "--out", here, "--name", "dog2", quiet=True)
            ground = {"terrain.kind": "map", "terrain.map": str(here / "hills.csv")}
            envs = caudata.make_vec(str(here / "dog2.robot.toml"), num_envs=1, settings=ground)
            width, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
            still = [(np.zeros((actions, width), np.float32), np.zeros(actions, np.float32))]
            policy = caudata.write_policy(here / "policy.onnx", envs, still, activation="elu")
            folder = hub.export(pathlib.Path(policy), pathlib.Path(scratch, "dog"))
            here.rename(pathlib.Path(scratch, "away"))
            names = {str(path.relative_to(folder)) for path in folder.rglob("*")}
            self.assertLessEqual({"robot/dog2.robot.toml", "robot/dog2.xml", "ground.csv", "config.toml"}, names)
            settings = (folder / "config.toml").read_text()
            self.assertNotIn(str(here), settings)
            self.addCleanup(os.chdir, os.getcwd())
            os.chdir(folder)
            caudata.run("eval", "policy.onnx", "--episodes", "1", "--seconds", "4", quiet=True)
            os.chdir("/")

    def test_a_training_is_handed_to_a_tracker_while_it_goes_on(self):
        from caudata import track

        got = {"curves": [], "files": [], "ended": 0}

        def tracker(name, settings):
            got.update(name=name, seed=settings.get("run.seed"))
            end = lambda: got.update(ended=got["ended"] + 1)  # noqa: E731
            return track.Tracker(lambda *point: got["curves"].append(point), got["files"].append, end)

        def finished(sha256, reason="completed"):
            return {"event": "finished", "reason": reason, "policy_sha256": sha256}

        events = [
            {"event": "started", "run_id": "walk"},
            {"event": "iteration", "iteration": 7, "mean_return": 2.5, "kl": 0.01, "reward_terms": {"slip": -1.0}},
            finished("a", "SIGTERM"),
            {"event": "iteration", "iteration": 8, "mean_return": None, "kl": 0.02, "reward_terms": {}},
            finished("b"),
        ]
        lines = "".join(json.dumps(event) + "\n" for event in events)
        with tempfile.TemporaryDirectory() as scratch, mock.patch.dict(track.TRACKERS, {"wandb": tracker}):
            run = pathlib.Path(scratch, "walk")
            run.mkdir()
            (run / "config.toml").write_text("[run]\nseed = 3\n")
            half = len(lines) // 2
            (run / "progress.jsonl").write_text(lines[:half])

            # The rest of a line comes late, then the report of the run before it went on, then its own.
            def go_on(_, reports=iter("ab")):
                if (run / "progress.jsonl").stat().st_size < len(lines):
                    with open(run / "progress.jsonl", "a") as file:
                        file.write(lines[half:])
                report = {"finished": finished(next(reports)), "evaluation": {"vx_mps": {"mean": 0.3}, "name": "flat"}}
                (run / "report.json").write_text(json.dumps(report))

            with mock.patch("caudata.track._OVER.wait", go_on):
                self.assertEqual(track.track(run, "wandb", 60), 2)
            # Beside a run that goes on, an old end with its report is none; without report, what is waited for is said.
            (run / "progress.jsonl").write_text(lines)
            lock = open(run / "supervisor.lock", "w")
            self.addCleanup(lock.close)
            fcntl.flock(lock, fcntl.LOCK_EX)
            for until_told, at_work, report, looks in (
                (True, True, True, 2), (False, True, True, 0), (False, True, False, 2), (True, False, False, 0),
            ):  # fmt: skip
                if not report:
                    (run / "report.json").unlink(missing_ok=True)
                fcntl.flock(lock, fcntl.LOCK_EX if at_work else fcntl.LOCK_UN)
                waits, said = [], io.StringIO()
                over = mock.Mock(is_set=lambda waits=waits: len(waits) == 2, wait=waits.append)
                with mock.patch("caudata.track._OVER", over), contextlib.redirect_stdout(said):
                    self.assertEqual(list(track.events(run, 60, until_told)), events)
                self.assertEqual(len(waits), looks)
                self.assertEqual("evaluation, is waited for 60 s" in said.getvalue(), not until_told and bool(looks))
        values = {"Train/mean_reward": 2.5, "Caudata/kl": 0.01, "Episode/slip": -1.0}
        self.assertEqual(got["curves"], [(values, 7), ({"Caudata/kl": 0.02}, 8), ({"Evaluation/vx_mps": 0.3}, 8)])
        files = [path.name for path in got["files"]]
        self.assertEqual((got["name"], files), ("walk", ["config.toml", "report.json"]))
        self.assertEqual(got["ended"], 1)
        self.assertIn(got["seed"], (3, None))  # None: Python 3.10 reads no TOML

    def test_a_tracker_that_is_told_that_the_run_is_over_hands_over_what_is_there(self):
        with tempfile.TemporaryDirectory() as scratch:
            run = pathlib.Path(scratch, "run")
            run.mkdir()
            (run / "config.toml").write_text("")
            event = {"event": "iteration", "iteration": 1, "kl": 0.5, "reward_terms": {}}
            (run / "progress.jsonl").write_text(json.dumps(event) + "\n{")
            (run / "wandb").mkdir()  # what the package itself writes there
            # As those packages would be, each call a line.
            (run / "stubs").mkdir()
            (run / "stubs" / "wandb.py").write_text(
                "class Run:\n url = 'here'\n def log(self, values, step): print(step, values)\n"
                " def save(self, path, **_): print(path)\n def finish(self): print('end')\n"
                "init = lambda **_: Run()\n"
            )
            command = [sys.executable, "-m", "caudata.track", ".", "--to", "wandb"]
            stubs = {"cwd": run, "env": {**os.environ, "PYTHONPATH": str(run / "stubs")}, "text": True}
            with subprocess.Popen(command, stdout=subprocess.PIPE, **stubs) as tracker:
                self.assertEqual(tracker.stdout.readline(), "tracked at here\n")
                tracker.terminate()
                # not communicate(), which loses what came with the first line
                rest = tracker.stdout.read().splitlines()
            self.assertEqual(rest, ["1 {'Caudata/kl': 0.5}", "config.toml", "end", "1 iterations are in wandb"])
            self.assertEqual(tracker.returncode, 0)
            for fault, said in (
                ("import no_such_package", "No module named 'no_such_package'; `pip install mlflow`"),
                ("raise RuntimeError('no key:\\n log in')", "mlflow: RuntimeError: no key: log in"),
            ):
                (run / "stubs" / "mlflow.py").write_text(fault)
                done = subprocess.run(command[:-1] + ["mlflow"], capture_output=True, **stubs)
                self.assertEqual((done.returncode, done.stderr), (69, "error: %s\n" % said))

    @needs("nbclient", "ipykernel")
    def test_the_notebook_runs(self):
        import nbclient
        import nbformat

        with tempfile.TemporaryDirectory() as folder:
            notebook = nbformat.read(EXAMPLES / "tour.ipynb", as_version=4)
            nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}}).execute()
        printed = "".join(out.get("text", "") for cell in notebook.cells for out in cell.get("outputs", []))
        for said in ("m/s walks: True", "viscous_friction"):
            self.assertIn(said, printed)

    def test_a_policy_for_another_task_is_refused(self):
        with self.assertRaisesRegex(ValueError, "observation"):
            caudata.Policy("amphibious").check(caudata.make_vec("polymander", "flat", 1))

    def test_programs_run_and_say_what_was_wrong(self):
        self.assertEqual("caudata " + caudata.__version__, caudata.run("--version").splitlines()[0].strip())
        with self.assertRaisesRegex(caudata.ProgramError, "unicorn") as raised:
            caudata.run("eval", "unicorn.onnx", quiet=True)
        self.assertEqual(raised.exception.code, 66)

    def test_the_set_up_explains_itself_before_it_loads_anything(self):
        done = subprocess.run([sys.executable, "-m", "caudata.setup", "--help"], capture_output=True, text=True)
        self.assertEqual((done.returncode, done.stderr), (0, ""))
        self.assertIn("libtorch", done.stdout)

    def test_an_evaluation(self):
        out = caudata.evaluate("flat", preset="flat", episodes=4, seconds=6)
        self.assertAlmostEqual(out.velocity_mps, 0.3, delta=0.06)
        self.assertEqual(out.policy_sha256, caudata.Policy("flat").sha256)

    def test_a_log_is_read_and_diagnosed(self):
        # A servo that swings a weight: once as its file says, and measured with three times the friction.
        robot = caudata.robot_path("xl330_pendulum")
        time_s = np.arange(0, 6, 0.01)
        with tempfile.TemporaryDirectory() as folder:
            for run in range(2):
                log = os.path.join(folder, "logs", "run_%d" % run)
                os.makedirs(log)
                commands = os.path.join(folder, "commands.csv")
                angle_rad = 0.8 * np.sin((1.5 + run) * time_s)
                rows = ["%.2f,%.6f" % pair for pair in zip(time_s, angle_rad)]
                with open(commands, "w") as file:
                    file.write("\n".join(["t,cmd.swing", *rows, ""]))
                caudata.run("sim", "rollout", "--robot", robot, "--commands", commands, "--base", "fixed",
                            "--rate-hz", "100", "--out", os.path.join(log, "log.csv"),
                            "--set", "lane.joint_damping_nms_per_rad=0.02", quiet=True)  # fmt: skip
            read = caudata.read_log(log)
            self.assertEqual(read.meta["rate_hz"], 100)
            self.assertGreater(len(read), 550)
            self.assertEqual(list(read.joints("pos")), ["swing"])
            self.assertLess(np.nanmax(np.abs(read["pos.swing"])), 0.9)
            self.assertIn("swing", example("read_a_log.py", log))
            report = caudata.diagnose(os.path.join(folder, "logs"), robot, only=["viscous_friction"], threads=1)
            self.assertEqual([cause.effect for cause in report.causes], ["viscous_friction"])
            self.assertIsNone(report.folder)
            with self.assertRaises(ValueError):
                caudata.read_log(folder)

    def test_a_log_opens_in_the_tools_of_ros(self):
        with tempfile.TemporaryDirectory() as folder:
            out = walk(folder)
            with open(out, "rb") as file:
                summary = mcap_summary(file)
            self.assertEqual(summary["/tf"][0], "tf2_msgs/msg/TFMessage")
            self.assertLessEqual(ROS_TOPICS, set(summary))
            self.assertIn("<robot", summary["/robot_description"][1][0].data)
            back = os.path.join(folder, "back.csv")
            caudata.run("log", "convert", out, "--out", back)
            with open(back) as file:
                self.assertEqual(file.readline().split(",")[0], "t")

    def test_an_evaluation_opens_in_the_tools_of_ros(self):
        with tempfile.TemporaryDirectory() as folder:
            logs, out = os.path.join(folder, "logs"), os.path.join(folder, "walk.mcap")
            words = ["--suite", "rough", "--episodes", "1", "--seconds", "5", "--log", logs]
            caudata.run("eval", caudata.policy_path("rough"), *words, quiet=True)
            self.assertEqual(len(os.listdir(logs)), 3)
            with self.assertRaisesRegex(caudata.ProgramError, "not empty"):
                caudata.run("eval", caudata.policy_path("rough"), *words, quiet=True)
            caudata.run("log", "convert", os.path.join(logs, sorted(os.listdir(logs))[0]), "--out", out)
            with open(out, "rb") as file:
                summary = mcap_summary(file)
            # 5 s at 50 Hz; the step that ends an episode begins the next.
            self.assertEqual(len(summary["/joint_states"][1]), 249)
            begin, end = (pose.pose.position for pose in summary["/base/pose"][1][::248])
            self.assertGreater(np.hypot(end.x - begin.x, end.y - begin.y), 1.0)  # 5 s at 0.3 m/s, with a start
            self.assertIn("<robot", summary["/robot_description"][1][0].data)

    @needs("tensorboard")
    def test_tensorboard_reads_an_evaluation(self):
        from caudata._programs import finish
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        with tempfile.TemporaryDirectory() as board:
            words = ["--suite", "acceptance", "--episodes", "1", "--seconds", "4", "--json", "--tensorboard", board]
            result = json.loads(finish("eval", caudata.policy_path("flat"), *words, quiet=True).stdout.splitlines()[-1])
            rows = result["acceptance"]
            events = EventAccumulator(board)
            events.Reload()
            speed = events.Scalars("Evaluation/%s/vx_mps" % result["scenarios"][0]["name"])[0]
            self.assertAlmostEqual(speed.value, result["scenarios"][0]["vx_mps"]["mean"], places=6)
            self.assertEqual(speed.step, result["policy_version"])
            tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("Acceptance/")]
            measured = {"Acceptance/" + row["name"]: row["measured"] for row in rows if row["measured"] is not None}
            self.assertEqual(set(tags), {"Acceptance/met", *measured})
            for tag, value in measured.items():
                self.assertAlmostEqual(events.Scalars(tag)[0].value, value, delta=1e-5 * max(1.0, abs(value)))
            (verdict,) = events.Tensors("Evaluation/verdict/text_summary")
            text = verdict.tensor_proto.string_val[0].decode()
            for row in rows:
                self.assertIn("| %s |" % row["name"], text)
            self.assertEqual(text.count(" | missed | "), sum(not row["met"] for row in rows))

    def test_an_own_reward(self):
        self.assertIn("mean reward", example("own_reward.py"))

    def test_the_examples_are_in_the_package(self):
        command = [sys.executable, "-m", "caudata.examples.own_reward"]
        self.assertIn("mean reward", subprocess.run(command, capture_output=True, text=True).stdout)
        there = {path.name for path in (pathlib.Path(caudata.__file__).parent / "examples").iterdir()}
        self.assertLessEqual({path.name for path in EXAMPLES.glob("*.*")}, there)

    @needs("torch")
    def test_ppo(self):
        small = ["--num-envs", "16", "--num-steps", "8", "--iterations", "3", "--print-every", "1"]
        self.assertIn("3/3", example("ppo.py", *small))

    @needs("stable_baselines3")
    def test_ppo_of_stable_baselines3(self):
        from stable_baselines3.common.env_checker import check_env

        check_env(caudata.make("polymander", "quick"), skip_render_check=True)
        with tempfile.TemporaryDirectory() as folder:
            small = ["--num-envs", "16", "--n-steps", "8", "--steps", "256"]
            example("sb3_ppo.py", "--robot", "quadruped", "--out", folder, *small)
            self.assertEqual(caudata.Policy(os.path.join(folder, "policy.onnx")).metadata["env_steps"], 256)

    @needs("stable_baselines3")
    def test_a_policy_of_stable_baselines3_computes_the_same(self):
        from caudata.sb3 import SB3VecEnv, write_policy
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import VecNormalize

        envs = VecNormalize(SB3VecEnv(caudata.make_vec("quadruped", num_envs=4)))
        model = PPO("MlpPolicy", envs, n_steps=8, batch_size=32, device="cpu")
        model.learn(64)
        observations = envs.reset()
        with tempfile.TemporaryDirectory() as folder:
            policy = caudata.Policy(write_policy(os.path.join(folder, "policy.onnx"), model))
            actions = policy(envs.get_original_obs())
        mean = model.policy.get_distribution(model.policy.obs_to_tensor(observations)[0]).distribution.mean
        np.testing.assert_allclose(actions, mean.detach().numpy(), atol=1e-5)

    @needs("rsl_rl")
    def test_ppo_of_rsl_rl(self):
        with tempfile.TemporaryDirectory() as folder:
            example("rsl_rl_ppo.py", "--robot", "quadruped", "--num-envs", "16", "--iterations", "2", "--out", folder)
            self.assertEqual(caudata.Policy(os.path.join(folder, "policy.onnx")).metadata["env_steps"], 2 * 48 * 16)

    @needs("rsl_rl")
    def test_a_policy_of_rsl_rl_computes_the_same(self):
        from caudata.rsl_rl import RslRlVecEnv, write_policy
        from rsl_rl.runners import OnPolicyRunner

        sys.path.insert(0, str(EXAMPLES))
        self.addCleanup(sys.path.remove, str(EXAMPLES))
        from rsl_rl_ppo import CONFIGURATION

        envs = RslRlVecEnv(caudata.make_vec("quadruped", num_envs=4))
        with tempfile.TemporaryDirectory() as folder:
            runner = OnPolicyRunner(envs, CONFIGURATION, folder, "cpu")
            runner.learn(1)
            policy = caudata.Policy(write_policy(os.path.join(folder, "policy.onnx"), runner))
        observations = envs.get_observations()
        want = runner.get_inference_policy()(observations).detach().numpy()
        np.testing.assert_allclose(policy(observations["policy"].numpy()), want, atol=1e-5)


if __name__ == "__main__":
    unittest.main()
