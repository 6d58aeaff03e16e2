//! A tick of the loop asks the allocator for nothing, but for the two small pieces that the binding of ONNX
//! Runtime makes for every run.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]
// Only the allocator sees every allocation; an allocator cannot be written without `unsafe`.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::Duration;

use caudata_deploy::bus::{BusError, Imu, ImuReading, Robot, ServoBus, ServoReadings};
use caudata_deploy::control::{ControlLoop, FALLEN_FOR, LegOdometry, READ_DEADLINE, RunPlan};
use caudata_deploy::flight_log::{FlightLog, meta};
use caudata_deploy::metrics::RobotMetrics;
use caudata_deploy::pacing::Clock;
use caudata_deploy::runner::PolicyRunner;
use caudata_deploy::state::{PolicyRef, Sha256Digest};
use caudata_deploy::summary::Ended;
use caudata_deploy::updates::{Slot, Updates};
use caudata_deploy::verify::verify;
use caudata_deploy::walk_command::{CommandTable, WalkCommand};
use caudata_model::RobotModel;
use caudata_task::PerJoint;
use caudata_telemetry::{Metrics, StopFlag};
use sha2::{Digest, Sha256};

thread_local! {
    /// Whether allocations of this thread count.
    static WATCHED: Cell<bool> = const { Cell::new(false) };
}
static COUNT: AtomicUsize = AtomicUsize::new(0);

struct Counting;

fn note() {
    // A thread that is being taken down has no such cell any more, and is none of ours.
    if WATCHED.try_with(Cell::get).unwrap_or(false) {
        COUNT.fetch_add(1, Relaxed);
    }
}

// SAFETY: every call goes to the system's allocator unchanged; calls are only counted beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: the caller keeps `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: `memory` came from `System.alloc` with this layout.
        unsafe { System.dealloc(memory, layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note();
        // SAFETY: `memory` came from `System.alloc` with this layout.
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Ticks between which allocations count: walking has begun, and the trial has not ended (which is told once,
/// by name).
const FROM: u32 = 200;
const TO: u32 = 600;

/// Servos that are where they were sent.
struct Still {
    pos_rad: PerJoint,
    ticks: u32,
    /// Set where an allocation is to be made on purpose.
    leaks: bool,
}

impl ServoBus for Still {
    fn read(&mut self, _: Duration) -> Result<ServoReadings, BusError> {
        Ok(ServoReadings {
            time_s: 0.02 * f64::from(self.ticks),
            pos_rad: self.pos_rad,
            vel_radps: PerJoint::filled(16, 0.0),
            current_a: PerJoint::filled(16, 0.0),
            supply_v: 12.0,
        })
    }

    fn write(&mut self, targets_rad: &PerJoint) -> Result<(), BusError> {
        self.pos_rad = *targets_rad;
        self.ticks += 1;
        WATCHED.set((FROM..TO).contains(&self.ticks));
        if self.leaks && self.ticks == FROM + 1 {
            std::hint::black_box(vec![0u8; 64]);
        }
        Ok(())
    }

    fn torque_off(&mut self) -> Result<(), BusError> {
        Ok(())
    }
}

impl Imu for Still {
    fn reading(&mut self) -> Result<ImuReading, BusError> {
        Ok(ImuReading { gyro_radps: [0.0; 3], acc_mps2: [0.0, 0.0, 9.81], gravity: None })
    }
}

impl Robot for Still {}

/// Sleeping moves it on.
#[derive(Default)]
struct NoTime(Cell<Duration>);

impl Clock for NoTime {
    fn now(&self) -> Duration {
        self.0.get()
    }

    fn sleep_until(&self, time: Duration) {
        self.0.set(self.0.get().max(time));
    }
}

/// Allocations of the loop's thread in 400 walking ticks of the shipped policy, flight log and recorder
/// included.
fn allocations(leaks: bool) -> usize {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let model = Arc::new(RobotModel::load(&root.join("robots/polymander.robot.toml")).unwrap());
    let bytes = std::fs::read(root.join("policies/flat.onnx")).unwrap();
    let version =
        caudata_policy::PolicyFile::parse(Arc::from(bytes.as_slice())).unwrap().metadata().version;
    let policy = PolicyRef {
        stream: "s".to_owned(),
        version,
        sha256: Sha256Digest(Sha256::digest(&bytes).into()),
        reverts_to: None,
    };
    let verified = verify(bytes.into(), &policy, &model).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut robot = Still { pos_rad: PerJoint::filled(16, 0.0), ticks: 0, leaks };
    let plan = RunPlan {
        period: Duration::from_millis(20),
        walk_s: Some(20.0),
        commands: CommandTable::constant(WalkCommand([0.2, 0.0, 0.0])),
        step_max_rad: 0.3,
        read_deadline: READ_DEADLINE,
        limits: None,
        swap_wait: None,
        get_up: FALLEN_FOR,
        balances: false,
        legs: LegOdometry::new(model.clone()),
    };
    let (updates, _events) = Updates::new(Slot::default());
    let metrics = RobotMetrics::register(&Metrics::new());
    let runner = PolicyRunner::new(verified, None).unwrap();
    let clock = NoTime::default();
    let mut control =
        ControlLoop::start(&mut robot, &clock, plan, runner, updates, metrics).unwrap();
    let first = *control.first().unwrap();
    let meta = meta(&model, &policy, 0.02, 12.0, "");
    let log = FlightLog::create(&folder.path().join("log"), &model, &meta, &first.truth).unwrap();
    control.log = Some(log);
    COUNT.store(0, Relaxed);
    assert_eq!(control.run(&StopFlag::new()).unwrap(), Ended::Time);
    WATCHED.set(false);
    let (log, counts) = control.into_parts();
    log.unwrap().finish().unwrap();
    assert!(counts.ticks > u64::from(TO));
    COUNT.load(Relaxed)
}

/// The same of as many runs of the shipped policy alone.
fn allocations_of_inference() -> usize {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../policies/flat.onnx");
    let file = caudata_policy::PolicyFile::parse(Arc::from(std::fs::read(path).unwrap())).unwrap();
    let mut inference = caudata_policy::Inference::new(&file, 1).unwrap();
    let obs = vec![0.0; inference.obs_dim()];
    let mut actions = [0.0; 16];
    inference.run(&obs, 1, &mut actions).unwrap();
    COUNT.store(0, Relaxed);
    WATCHED.set(true);
    for _ in FROM..TO {
        inference.run(&obs, 1, &mut actions).unwrap();
    }
    WATCHED.set(false);
    COUNT.load(Relaxed)
}

#[test]
fn a_walking_tick_allocates_nothing_itself() {
    let inference = allocations_of_inference();
    let ticks = (TO - FROM) as usize;
    println!("{} allocations in {ticks} runs of ONNX Runtime's binding", inference);
    assert!(inference <= 2 * ticks, "{inference}");
    assert_eq!(allocations(true), inference + 1, "the count sees one that is made on purpose");
    assert_eq!(allocations(false), inference);
}
