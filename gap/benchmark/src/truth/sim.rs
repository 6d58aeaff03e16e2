//! The truth in time: firmware every 0.5 ms, everything else by the classical Runge–Kutta method in steps of
//! 0.25 ms.

use caudata_model::{JointKind, RobotModel};

use super::drive::{self, AUX, Firmware, ROTOR, SWING};
use super::linear::solve_spd;
use super::spec::Spec;
use super::tree::{Scratch, Tree};

/// Step of the integration, s: an eighth of the diagnosing simulator's.
pub const STEP_S: f64 = 0.00025;
/// Integration steps per firmware tick.
const STEPS_PER_TICK: usize = 2;
/// Integration steps per kept sample.
const STEPS_PER_SAMPLE: usize = 4;
/// How long the robot stands at the first command before the run begins, s.
const SETTLE_S: f64 = 1.0;
/// Time constant of the voltage behind wiring and capacitors, s.
const BUS_LAG_S: f64 = 0.004;
/// Speed over which a passive hinge's friction turns round, rad/s.
const PASSIVE_FADE_RADPS: f64 = 0.01;

/// A stepwise command: what is sent, when, and whether it arrives.
#[derive(Clone, Debug, Default)]
pub struct Commands {
    /// When each row is sent, s.
    pub sent_s: Vec<f64>,
    /// `[rows][A]`, rad.
    pub rows_rad: Vec<Vec<f64>>,
    /// Rows that never arrive.
    pub lost: Vec<bool>,
}

/// Somebody pushes: joint (policy order), from, to, torque.
#[derive(Clone, Copy, Debug)]
pub struct Touch {
    /// Joint, policy order.
    pub joint: usize,
    /// Beginning and end, s.
    pub span_s: (f64, f64),
    /// Torque at the joint, N·m.
    pub torque_nm: f64,
}

/// One run, densely: every [`SAMPLE_S`] from t = 0.
#[derive(Clone, Debug, Default)]
pub struct Dense {
    /// Actuated joints, `[A][samples]`, rad: true positions.
    pub pos_rad: Vec<Vec<f64>>,
    /// True speeds, rad/s.
    pub vel_radps: Vec<Vec<f64>>,
    /// Motor currents, A.
    pub current_a: Vec<Vec<f64>>,
    /// Winding temperatures above the surroundings, K.
    pub heat_k: Vec<Vec<f64>>,
    /// Bus, V.
    pub bus_v: Vec<f64>,
    /// Whether the numbers stayed finite.
    pub sane: bool,
}

/// Time between samples of [`Dense`], s.
pub const SAMPLE_S: f64 = STEP_S * STEPS_PER_SAMPLE as f64;

/// A true robot on its stand.
pub struct Sim<'a> {
    spec: &'a Spec,
    tree: Tree,
    /// For each degree of freedom: the servo, or none.
    servo: Vec<Option<usize>>,
    /// Degree of freedom of each servo.
    dof: Vec<usize>,
    passive: Vec<Option<Passive>>,
    encoder_lsb_rad: Vec<f64>,
    scratch: Scratch,
    mass: Vec<f64>,
    load_nm: Vec<f64>,
    bias: Vec<f64>,
    torque: Vec<f64>,
    flows: Vec<(usize, usize, drive::Flow)>,
}

#[derive(Clone, Copy)]
struct Passive {
    spring: f64,
    rest: f64,
    damping: f64,
    friction: f64,
    stops: (f64, f64),
}

impl<'a> Sim<'a> {
    /// `model` as `spec` has it.
    pub fn new(model: &RobotModel, spec: &'a Spec) -> Self {
        let tree = Tree::new(model, &spec.links, spec.gravity_mps2);
        let mut servo = Vec::new();
        let mut passive = Vec::new();
        let mut dof = vec![0; model.actuated().len()];
        for (d, &j) in tree.model_joint.iter().enumerate() {
            let joint = &model.joints()[j];
            if let JointKind::Actuated { index } = joint.kind {
                servo.push(Some(index));
                passive.push(None);
                dof[index] = d;
            } else {
                servo.push(None);
                let range = joint.range_rad.unwrap_or((-1e6, 1e6));
                passive.push(Some(Passive {
                    spring: joint.stiffness_nm_per_rad,
                    rest: joint.spring_ref_rad,
                    damping: joint.damping_nm_s_per_rad,
                    friction: joint.friction_loss_nm,
                    stops: spec.play_rad[j].map_or(range, |h| (-h, h)),
                }));
            }
        }
        let n = tree.dofs();
        Self {
            spec,
            tree,
            servo,
            dof,
            passive,
            encoder_lsb_rad: (0..spec.joints.len())
                .map(|a| model.servo(a).encoder_lsb_rad())
                .collect(),
            scratch: Scratch::default(),
            mass: vec![0.0; n * n],
            load_nm: vec![0.0; spec.joints.len()],
            bias: vec![0.0; n],
            torque: vec![0.0; n],
            flows: Vec::new(),
        }
    }

    /// Runs `commands` until `duration_s` after having stood at the first row for a second, from
    /// `start_error_rad` beside it.
    pub fn run(
        &mut self,
        commands: &Commands,
        duration_s: f64,
        start_error_rad: &[f64],
        touch: Option<Touch>,
    ) -> Dense {
        let n = self.tree.dofs();
        let servos = self.spec.joints.len();
        let mut y = vec![0.0; 2 * n + AUX * servos];
        let mut firmware = Vec::new();
        for a in 0..servos {
            let p = &self.spec.joints[a];
            let (low, high) = p.stops_rad;
            let q = (commands.rows_rad[0][a] + start_error_rad[a]).clamp(low, high);
            y[self.dof[a]] = q;
            let x = 2 * n + AUX * a;
            y[x + ROTOR] = q;
            y[x + SWING] = q;
            firmware.push(Firmware::at_rest(commands.rows_rad[0][a], p.encode_rad(q)));
        }
        let settle = (SETTLE_S / STEP_S).round() as i64;
        let steps = (duration_s / STEP_S).round() as i64;
        let mut volts = vec![0.0; servos];
        let mut currents = vec![0.0; servos];
        let mut bus = self.spec.supply_v;
        let mut work = vec![0.0; 5 * y.len()];
        let mut out = Dense::new(servos);
        let mut arrived = vec![0usize; servos];
        for step in -settle..=steps {
            let t = step as f64 * STEP_S;
            if step.rem_euclid(STEPS_PER_TICK as i64) == 0 {
                let compensation =
                    if self.spec.gain_follows_supply { bus / self.spec.reference_v } else { 1.0 };
                for a in 0..servos {
                    let p = &self.spec.joints[a];
                    let delay = self.spec.command_delay_s + self.spec.skew_s * a as f64;
                    advance(&mut arrived[a], commands, t - delay);
                    let read = p.encode_rad(y[self.dof[a]]);
                    let lsb = self.encoder_lsb_rad[a];
                    let counted = (read / lsb).round() * lsb;
                    let command = commands.rows_rad[arrived[a]][a];
                    volts[a] = firmware[a].tick(
                        p,
                        STEP_S * STEPS_PER_TICK as f64,
                        command,
                        counted,
                        read,
                        bus,
                        compensation,
                    );
                }
            }
            if step >= 0 && step % STEPS_PER_SAMPLE as i64 == 0 {
                out.push(&self.dof, &y, n, &currents, bus);
            }
            let push = touch.filter(|x| t >= x.span_s.0 && t < x.span_s.1);
            self.rk4(&mut y, &mut work, &volts, push, t, &mut currents);
            // what the bus gives, bus·drawn, is what the bridges put on the motors
            let drawn = volts.iter().zip(&currents).map(|(v, i)| v * i).sum::<f64>() / bus;
            let settled = self.spec.supply_v - self.spec.supply_ohm * drawn;
            bus += (settled - bus) * (STEP_S / BUS_LAG_S);
            bus = bus.max(0.2 * self.spec.supply_v);
        }
        out.sane = y.iter().all(|x| x.is_finite());
        out
    }

    /// One step of the classical method; takes note of currents and passed-on torques at its beginning.
    fn rk4(
        &mut self,
        y: &mut [f64],
        work: &mut [f64],
        volts: &[f64],
        push: Option<Touch>,
        t: f64,
        currents: &mut [f64],
    ) {
        let n = y.len();
        let (at, k) = work.split_at_mut(n);
        let (k1, k) = k.split_at_mut(n);
        let (k2, k) = k.split_at_mut(n);
        let (k3, k4) = k.split_at_mut(n);
        let ahead = |at: &mut [f64], h: f64, k: &[f64]| {
            for i in 0..n {
                at[i] = y[i] + h * k[i];
            }
        };
        self.rates(y, k1, volts, push, t, Some(currents));
        ahead(at, 0.5 * STEP_S, k1);
        self.rates(at, k2, volts, push, t + 0.5 * STEP_S, None);
        ahead(at, 0.5 * STEP_S, k2);
        self.rates(at, k3, volts, push, t + 0.5 * STEP_S, None);
        ahead(at, STEP_S, k3);
        self.rates(at, k4, volts, push, t + STEP_S, None);
        for i in 0..n {
            y[i] += STEP_S / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
    }

    /// Derivative of the state. With `currents`, also takes note of what the motors draw and pass on (for the
    /// next step).
    fn rates(
        &mut self,
        y: &[f64],
        rate: &mut [f64],
        volts: &[f64],
        push: Option<Touch>,
        t: f64,
        currents: Option<&mut [f64]>,
    ) {
        let n = self.tree.dofs();
        let (q, rest) = y.split_at(n);
        let (v, aux) = rest.split_at(n);
        self.tree.equations(q, v, &mut self.scratch, &mut self.mass, &mut self.bias);
        self.torque.fill(0.0);
        self.flows.clear();
        for d in 0..n {
            if let Some(a) = self.servo[d] {
                let p = &self.spec.joints[a];
                let x = &aux[AUX * a..AUX * (a + 1)];
                let flow = drive::flow(p, q[d], v[d], x, volts[a], self.load_nm[a], t, STEP_S);
                self.torque[d] += flow.on_link_nm;
                if !p.geared() {
                    self.mass[d * n + d] += p.rotor_kgm2;
                }
                rate[2 * n + AUX * a..2 * n + AUX * (a + 1)].copy_from_slice(&flow.rate);
                self.flows.push((a, d, flow));
            } else if let Some(p) = self.passive[d] {
                self.torque[d] += p.spring * (p.rest - q[d])
                    - p.damping * v[d]
                    - p.friction * (v[d] / PASSIVE_FADE_RADPS).clamp(-1.0, 1.0)
                    + stop(p.stops, q[d], v[d]);
            }
        }
        if let Some(push) = push {
            self.torque[self.dof[push.joint]] += push.torque_nm;
        }
        for (t, b) in self.torque.iter_mut().zip(&self.bias) {
            *t -= b;
        }
        let acc = &mut self.torque;
        if !solve_spd(&mut self.mass, acc) {
            acc.fill(f64::NAN);
        }
        if let Some(currents) = currents {
            for &(a, d, flow) in &self.flows {
                currents[a] = flow.current_a;
                // What the gear passes on: everything but what turns the rotor itself.
                let p = &self.spec.joints[a];
                let rotor = if p.geared() { 0.0 } else { p.rotor_kgm2 * acc[d] };
                self.load_nm[a] += 0.2 * (flow.on_link_nm - rotor - self.load_nm[a]);
            }
        }
        rate[..n].copy_from_slice(v);
        rate[n..2 * n].copy_from_slice(&self.torque);
    }
}

/// Stop of a passive hinge, N·m.
fn stop(stops: (f64, f64), q: f64, v: f64) -> f64 {
    const K: f64 = 800.0;
    const D: f64 = 1.5;
    let (low, high) = stops;
    if q < low {
        (K * (low - q) - D * v).max(0.0)
    } else if q > high {
        (-K * (q - high) - D * v).min(0.0)
    } else {
        0.0
    }
}

/// Moves `row` to the last row that was sent at `t` and arrived.
fn advance(row: &mut usize, commands: &Commands, t: f64) {
    let sent = commands.sent_s.partition_point(|&s| s <= t);
    let mut newest = *row;
    for k in *row..sent {
        if !commands.lost.get(k).copied().unwrap_or(false) {
            newest = k;
        }
    }
    *row = newest;
}

impl Dense {
    fn new(servos: usize) -> Self {
        let empty = || vec![Vec::new(); servos];
        Self {
            pos_rad: empty(),
            vel_radps: empty(),
            current_a: empty(),
            heat_k: empty(),
            bus_v: Vec::new(),
            sane: true,
        }
    }

    fn push(&mut self, dof: &[usize], y: &[f64], n: usize, currents: &[f64], bus: f64) {
        for (a, &d) in dof.iter().enumerate() {
            self.pos_rad[a].push(y[d]);
            self.vel_radps[a].push(y[n + d]);
            self.current_a[a].push(currents[a]);
            self.heat_k[a].push(y[2 * n + AUX * a + drive::HEAT]);
        }
        self.bus_v.push(bus);
    }
}

/// Value of a dense channel at time `t`, between samples in proportion; the ends hold.
pub fn at(channel: &[f64], t_s: f64) -> f64 {
    let x = (t_s / SAMPLE_S).max(0.0);
    let k = x.floor() as usize;
    match (channel.get(k), channel.get(k + 1)) {
        (Some(a), Some(b)) => a + (b - a) * (x - k as f64),
        _ => channel.last().copied().unwrap_or(0.0),
    }
}
