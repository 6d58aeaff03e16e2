//! Decoys: something unusual that is no hidden physics of the robot.

use crate::battery::Trial;
use crate::hidden::World;
use crate::truth::Touch;
use crate::truth::sensors::Row;
use caudata_declare::named;

named! {
    /// A decoy.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Decoy {
        /// Another gain, and the log says so.
        KpDeclared = "kp_declared",
        /// Another supply, and the log says so.
        SupplyDeclared = "supply_declared",
        /// Somebody touches the robot for a second in one repeat.
        Touch = "touch",
        /// A position with the sign turned round.
        Sign = "sign",
        /// Positions in degrees.
        Unit = "unit",
        /// Two joints' positions exchanged (arms; with one joint the speed's sign).
        Order = "order",
        /// Readings that jump ahead by 0.3 s in the middle of the run (stamps of another clock after a hiccup).
        Stamps = "stamps",
        /// A reading that is stuck for the second half.
        Stuck = "stuck",
    }
}

impl Decoy {
    /// Whether the data contradict themselves.
    pub fn is_fault(self) -> bool {
        !matches!(self, Self::KpDeclared | Self::SupplyDeclared | Self::Touch)
    }

    /// Kinds of fault that are right.
    pub fn kinds(self) -> &'static [&'static str] {
        match self {
            Self::Sign => &["sign", "parity"],
            Self::Unit => &["unit"],
            Self::Order => &["order", "sign", "parity"],
            Self::Stamps => &["stamps", "gap"],
            Self::Stuck => &["stuck"],
            _ => &[],
        }
    }

    /// The gain that the log gives, where it is another one.
    pub fn declared_kp(self) -> Option<f64> {
        (self == Self::KpDeclared).then_some(10.0)
    }

    /// Changes the robot.
    pub fn change_world(self, world: &mut World) {
        match self {
            Self::KpDeclared => {
                for p in &mut world.spec.joints {
                    p.kp_nm_per_rad = 10.0;
                }
            }
            Self::SupplyDeclared => world.spec.supply_v -= 1.5,
            _ => {}
        }
    }

    /// A touch in this run.
    pub fn touch(self, role: &str, trial: &Trial, repeat: u64) -> Option<Touch> {
        let here = self == Self::Touch && role == "fit" && trial.name == "chirp" && repeat == 1;
        here.then(|| Touch {
            joint: 0,
            span_s: (0.4 * trial.duration_s(), 0.4 * trial.duration_s() + 1.0),
            torque_nm: 0.35,
        })
    }

    /// Changes what was read. Columns: commands, positions, speeds, currents, …, each for all `servos`.
    pub fn change_rows(self, rows: &mut [Row], servos: usize) {
        let middle = rows.len() / 2;
        let pos = servos;
        let vel = 2 * servos;
        match self {
            Self::Sign => rows.iter_mut().for_each(|(_, row)| row[pos] = row[pos].map(|x| -x)),
            Self::Unit => {
                rows.iter_mut().for_each(|(_, row)| row[pos] = row[pos].map(f64::to_degrees))
            }
            Self::Order if servos > 1 => {
                rows.iter_mut().for_each(|(_, row)| row.swap(pos, pos + 1))
            }
            Self::Order => rows.iter_mut().for_each(|(_, row)| row[vel] = row[vel].map(|x| -x)),
            Self::Stamps => rows.iter_mut().skip(middle).for_each(|(t, _)| *t += 0.3),
            Self::Stuck => {
                let held = rows[middle].1[pos];
                rows.iter_mut().skip(middle).for_each(|(_, row)| row[pos] = held);
            }
            _ => {}
        }
    }
}
