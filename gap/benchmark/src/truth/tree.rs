//! Equations of motion of a tree of links on a base that is held: `M(q)·q̈ + h(q, q̇) = τ`, in world
//! coordinates.
//!
//! M from composite bodies, column by column as momenta about the world's origin; h (gravity included) by
//! Newton and Euler outwards and inwards. Written for the benchmark alone: shares no formula with the engines
//! that it examines.

use caudata_declare::settings;
use caudata_model::{JointMotion, RobotModel, pose};

use super::linear::{M3, V3, add, add3, cross, dot, mul, point_inertia, scale, sub, turn};

/// A link with its inertia.
#[derive(Clone, Debug)]
struct Body {
    parent: Option<usize>,
    placed: pose::Pose,
    mass_kg: f64,
    com_m: V3,
    inertia: M3,
    /// Degrees of freedom between parent and this body, outermost first.
    dofs: Vec<usize>,
}

/// One hinge.
#[derive(Clone, Debug)]
struct Hinge {
    axis: V3,
    anchor_m: V3,
    /// Nearest hinge that carries this one.
    parent: Option<usize>,
    body: usize,
}

/// A tree of bodies and hinges, held at its base.
#[derive(Clone, Debug)]
pub struct Tree {
    bodies: Vec<Body>,
    hinges: Vec<Hinge>,
    /// Model index of each degree of freedom.
    pub model_joint: Vec<usize>,
    gravity_mps2: V3,
    origin: pose::Pose,
}

/// Where everything is at one instant; kept to save allocations.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    axis: Vec<V3>,
    anchor: Vec<V3>,
    rotation: Vec<pose::Pose>,
    com: Vec<V3>,
    inertia: Vec<M3>,
    omega: Vec<V3>,
    alpha: Vec<V3>,
    force: Vec<V3>,
    torque: Vec<V3>,
    /// Acceleration of each link's frame origin, less gravity.
    origin_acc: Vec<V3>,
    composite: Vec<(f64, V3, M3)>,
}

settings! {
    /// What differs from the model's inertias.
    #[derive(Clone, Debug)]
    pub struct MassChange {
        /// Factor on mass and inertia.
        pub mass_scale: f64 = 1.0,
        /// Factor on the inertia about the centre of mass on top.
        pub inertia_scale: f64 = 1.0,
        /// Shift of the centre of mass, link frame, m.
        pub com_offset_m: V3 = [0.0; 3],
        /// A point mass, kg, at a place in the link frame, m.
        pub payload: (f64, V3) = (0.0, [0.0; 3]),
    }
}

impl Tree {
    /// The tree of `model` with its base held where the model puts it. Slides are left out (no rig here has
    /// one), as are locked hinges.
    pub fn new(model: &RobotModel, changes: &[MassChange], gravity_mps2: V3) -> Self {
        let mut hinges = Vec::new();
        let mut model_joint = Vec::new();
        let mut bodies: Vec<Body> = Vec::new();
        let mut last: Vec<Option<usize>> = Vec::new();
        for (i, link) in model.links().iter().enumerate() {
            let mut carrier = link.parent.and_then(|p| last[p]);
            let mut dofs = Vec::new();
            for &j in &link.joints {
                let joint = &model.joints()[j];
                if joint.locked || joint.motion != JointMotion::Hinge {
                    continue;
                }
                dofs.push(hinges.len());
                hinges.push(Hinge {
                    axis: joint.axis,
                    anchor_m: joint.anchor_m,
                    parent: carrier,
                    body: i,
                });
                model_joint.push(j);
                carrier = Some(hinges.len() - 1);
            }
            last.push(carrier);
            let change = changes.get(i).cloned().unwrap_or_default();
            bodies.push(changed(link, &change, dofs));
        }
        Self { bodies, hinges, model_joint, gravity_mps2, origin: pose::Pose::IDENTITY }
    }

    /// Degrees of freedom.
    pub fn dofs(&self) -> usize {
        self.hinges.len()
    }

    /// M and h at (q, q̇). `mass` `[n, n]` (lower triangle and diagonal are filled), `bias` `[n]`.
    pub fn equations(
        &self,
        q: &[f64],
        v: &[f64],
        s: &mut Scratch,
        mass: &mut [f64],
        bias: &mut [f64],
    ) {
        self.place(q, s);
        self.bias(v, s, bias);
        self.mass(s, mass);
    }

    /// Kinetic and potential energy, J; armatures not included.
    pub fn energy(&self, q: &[f64], v: &[f64], s: &mut Scratch) -> f64 {
        let n = self.dofs();
        let (mut mass, mut bias) = (vec![0.0; n * n], vec![0.0; n]);
        self.equations(q, v, s, &mut mass, &mut bias);
        let mut kinetic = 0.0;
        for i in 0..n {
            for j in 0..=i {
                let twice = if i == j { 1.0 } else { 2.0 };
                kinetic += 0.5 * twice * mass[i * n + j] * v[i] * v[j];
            }
        }
        let potential: f64 = self
            .bodies
            .iter()
            .zip(&s.com)
            .map(|(b, &c)| -b.mass_kg * dot(self.gravity_mps2, c))
            .sum();
        kinetic + potential
    }

    fn place(&self, q: &[f64], s: &mut Scratch) {
        s.axis.clear();
        s.anchor.clear();
        s.rotation.clear();
        s.com.clear();
        s.inertia.clear();
        for body in &self.bodies {
            let mut at = match body.parent {
                Some(p) => s.rotation[p].compose(&body.placed),
                None => self.origin.compose(&body.placed),
            };
            for &d in &body.dofs {
                let hinge = &self.hinges[d];
                let anchor = at.point(hinge.anchor_m);
                s.axis.push(at.rotate(hinge.axis));
                s.anchor.push(anchor);
                let turned = pose::quat_from_axis_angle(hinge.axis, q[d]);
                at.quat_wxyz = pose::quat_mul(at.quat_wxyz, turned);
                at.pos_m = sub(anchor, at.rotate(hinge.anchor_m));
            }
            s.com.push(at.point(body.com_m));
            s.inertia.push(turn(&at.rotation(), &body.inertia));
            s.rotation.push(at);
        }
    }

    /// Newton and Euler with q̈ = 0: what the hinges must give to keep the speeds.
    fn bias(&self, v: &[f64], s: &mut Scratch, bias: &mut [f64]) {
        let n = self.bodies.len();
        s.omega.clear();
        s.alpha.clear();
        s.force.clear();
        s.torque.clear();
        s.origin_acc.clear();
        for (i, body) in self.bodies.iter().enumerate() {
            let (mut w, mut al, mut acc, mut point) = match body.parent {
                Some(p) => (s.omega[p], s.alpha[p], s.origin_acc[p], s.rotation[p].pos_m),
                None => ([0.0; 3], [0.0; 3], scale(self.gravity_mps2, -1.0), s.rotation[i].pos_m),
            };
            for &d in &body.dofs {
                // to the anchor, rigidly with what carries it
                let r = sub(s.anchor[d], point);
                acc = add(acc, add(cross(al, r), cross(w, cross(w, r))));
                point = s.anchor[d];
                let spin = scale(s.axis[d], v[d]);
                al = add(al, cross(w, spin));
                w = add(w, spin);
            }
            let r = sub(s.rotation[i].pos_m, point);
            acc = add(acc, add(cross(al, r), cross(w, cross(w, r))));
            let rc = sub(s.com[i], s.rotation[i].pos_m);
            let com_acc = add(acc, add(cross(al, rc), cross(w, cross(w, rc))));
            let spin = mul(&s.inertia[i], w);
            s.force.push(scale(com_acc, body.mass_kg));
            s.torque.push(add(mul(&s.inertia[i], al), cross(w, spin)));
            s.omega.push(w);
            s.alpha.push(al);
            s.origin_acc.push(acc);
        }
        // Inwards: force and moment about the world's origin, so that they simply add.
        for i in 0..n {
            s.torque[i] = add(s.torque[i], cross(s.com[i], s.force[i]));
        }
        let moment = &mut s.torque;
        for i in (0..n).rev() {
            for &d in self.bodies[i].dofs.iter().rev() {
                bias[d] = dot(s.axis[d], sub(moment[i], cross(s.anchor[d], s.force[i])));
            }
            if let Some(p) = self.bodies[i].parent {
                moment[p] = add(moment[p], moment[i]);
                s.force[p] = add(s.force[p], s.force[i]);
            }
        }
    }

    /// Composite bodies: mass, first moment and inertia about the world's origin of everything beyond a
    /// hinge.
    fn mass(&self, s: &mut Scratch, mass: &mut [f64]) {
        let n = self.dofs();
        s.composite.clear();
        for (i, body) in self.bodies.iter().enumerate() {
            let about = add3(&s.inertia[i], &point_inertia(body.mass_kg, s.com[i]));
            s.composite.push((body.mass_kg, scale(s.com[i], body.mass_kg), about));
        }
        for i in (0..self.bodies.len()).rev() {
            if let Some(p) = self.bodies[i].parent {
                let (m, c, j) = s.composite[i];
                let to = &mut s.composite[p];
                to.0 += m;
                to.1 = add(to.1, c);
                to.2 = add3(&to.2, &j);
            }
        }
        mass.fill(0.0);
        for d in 0..n {
            let (m, first, about) = s.composite[self.hinges[d].body];
            let (axis, anchor) = (s.axis[d], s.anchor[d]);
            // Unit speed about this hinge: v(x) = a × (x − p).
            let shift = cross(anchor, axis);
            let momentum = add(cross(axis, first), scale(shift, m));
            let spin = add(mul(&about, axis), cross(first, shift));
            let mut at = Some(d);
            while let Some(e) = at {
                let moment = sub(spin, cross(s.anchor[e], momentum));
                mass[d * n + e] = dot(s.axis[e], moment);
                at = self.hinges[e].parent;
            }
        }
    }
}

fn changed(link: &caudata_model::Link, change: &MassChange, dofs: Vec<usize>) -> Body {
    let own = link.mass_kg * change.mass_scale;
    let own_com = add(link.com_m, change.com_offset_m);
    let (load, at) = change.payload;
    let mass_kg = own + load;
    let com_m = scale(add(scale(own_com, own), scale(at, load)), 1.0 / mass_kg);
    let mut inertia =
        link.inertia_kgm2.map(|row| row.map(|x| x * change.mass_scale * change.inertia_scale));
    inertia = add3(&inertia, &point_inertia(own, sub(own_com, com_m)));
    inertia = add3(&inertia, &point_inertia(load, sub(at, com_m)));
    Body { parent: link.parent, placed: link.parent_from_link, mass_kg, com_m, inertia, dofs }
}
