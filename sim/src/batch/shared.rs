//! What the groups of an engine share, and what a thread works with.

use super::aba::{Hinge, Load};
use super::clock::{Clock, Phase};
use super::contact_law::{ContactLaw, Touch};
use super::frame::Frame;
use super::ground::Ground;
use super::group::{layout, sums_len};
use super::program::Program;
use super::readout::Readout;
use super::vec3::{Inertia, V3, zero3};
use crate::EngineConfig;
use crate::drive::JointMemory;
use crate::drive::command::Scheduled;
use crate::drive::step::{Driven, Step};
use crate::simd::Lanes;

/// What every group of an engine shares.
#[derive(Debug, Clone)]
pub(super) struct Shared<R: Lanes> {
    pub program: Program<R>,
    pub ground: Ground<R>,
    pub law: ContactLaw<R>,
    pub dt_s: f64,
    pub substeps: u32,
    pub step: Step<R>,
    /// Height of the water's surface as the terrain has it, m.
    pub water_level_m: f64,
    pub max_joint_speed: f64,
    pub max_base_speed: f64,
    /// What each period reports.
    pub readout: Readout,
    /// Whether a lane has had an encoder that may be ahead of its joint.
    pub ahead: bool,
}

impl<R: Lanes> Shared<R> {
    pub fn new(
        program: Program<R>,
        ground: Ground<R>,
        config: &EngineConfig,
        water_level_m: f64,
    ) -> Self {
        Self {
            program,
            ground,
            law: ContactLaw::new(config),
            dt_s: config.dt_s,
            substeps: config.substeps,
            step: Step::new(config.dt_s, config.centred),
            water_level_m,
            max_joint_speed: config.max_joint_speed_radps,
            max_base_speed: config.max_base_speed_mps,
            readout: Readout::ALL,
            ahead: false,
        }
    }

    pub fn period_s(&self) -> f64 {
        self.dt_s * f64::from(self.substeps)
    }
}

/// Working memory of one thread; nothing in it outlives a period.
#[derive(Debug, Clone)]
pub(super) struct Scratch<R: Lanes> {
    pub frames: Vec<Frame<R>>,
    pub inertias: Vec<Inertia<R>>,
    pub hinges: Vec<Hinge<R>>,
    pub loads: Vec<Load<R>>,
    pub beyond: Vec<(V3<R>, V3<R>)>,
    pub qdd: Vec<R>,
    pub touches: Vec<Touch<R>>,
    /// Centres of the contact points, for those that may touch each other.
    pub centres: Vec<V3<R>>,
    /// State and sums at the start of the period.
    pub saved: Vec<R>,
    pub saved_sums: Vec<R>,
    pub saved_drives: Vec<JointMemory<R>>,
    /// New commands. `[A]`
    pub targets: Vec<R>,
    /// What arrives at each servo in the current control period. `[A]`
    pub scheduled: Vec<Scheduled<R>>,
    /// What each servo gives in the current step. `[A]`
    pub driven: Vec<Option<Driven<R>>>,
    /// Report, see [`super::report`].
    pub out: Vec<R>,
    /// The same as plain numbers, 16 per register.
    pub turned: Vec<f32>,
    /// Centre of mass and its velocity per link.
    pub coms: Vec<(V3<R>, V3<R>)>,
    /// Runs where somebody asked for the time split by phase.
    pub clock: Option<Clock>,
}

impl<R: Lanes> Scratch<R> {
    pub fn new(program: &Program<R>) -> Self {
        let o = R::zero();
        let n = program.nodes.len();
        Self {
            frames: vec![Frame::zero(); n + 1],
            inertias: vec![Inertia::zero(); n + 1],
            hinges: vec![Hinge::zero(); n],
            loads: vec![Load { torque: o, inertia: o }; n],
            beyond: vec![(zero3(), zero3()); n + 1],
            qdd: vec![o; n],
            touches: vec![Touch::none(); program.points.len()],
            centres: vec![zero3(); program.points.len()],
            saved: vec![o; layout(program).len()],
            saved_sums: vec![o; sums_len(program)],
            saved_drives: vec![JointMemory::default(); program.actuated],
            targets: vec![o; program.actuated],
            scheduled: vec![Scheduled::constant(o); program.actuated],
            driven: vec![None; program.actuated],
            out: vec![o; program.report_len()],
            turned: vec![0.0; 16 * program.report_len()],
            coms: vec![(zero3(), zero3()); program.links.len()],
            clock: None,
        }
    }

    #[inline(always)]
    pub fn mark(&mut self, phase: Phase) {
        if let Some(clock) = &mut self.clock {
            clock.mark(phase);
        }
    }
}
