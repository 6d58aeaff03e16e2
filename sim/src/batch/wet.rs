//! Water on the links ([`crate::water`]), taken into their inertias after the outward pass.
//!
//! Drag is taken at the end of the step: its secant damping goes into the articulated inertia, so no step is
//! too large for it. Added mass goes there as it is.

use super::contact::add_general;
use super::frame::Frame;
use super::group::GroupParams;
use super::program::Program;
use super::vec3::{Inertia, V3, add, add_cross, add_scaled, cross, sub, sym_times, turn, turn_sym};
use crate::simd::Lanes;
use crate::water::{self, LinkMotion};

/// Adds buoyancy, drag and added mass of every link to its node.
#[inline(always)]
pub(super) fn immerse<R: Lanes>(
    program: &Program<R>,
    params: &GroupParams<R>,
    centre_z: R,
    dt: R,
    frames: &[Frame<R>],
    inertias: &mut [Inertia<R>],
) {
    for (i, place) in program.links.iter().enumerate() {
        if place.node == 0 && !program.free {
            continue;
        }
        let frame = &frames[place.node];
        // world from link, columns
        let mut rot = [[R::zero(); 3]; 3];
        for c in 0..3 {
            let column = place.columns[c];
            rot[c] = turn(
                &frame.rot,
                [R::uniform(column[0]), R::uniform(column[1]), R::uniform(column[2])],
            );
        }
        let com = add(frame.pos, turn(&frame.rot, params.links[i].com));
        let vel = frame.velocity(com);
        let at = LinkMotion {
            rotation: [
                [rot[0][0], rot[1][0], rot[2][0]],
                [rot[0][1], rot[1][1], rot[2][1]],
                [rot[0][2], rot[1][2], rot[2][2]],
            ],
            origin_z_m: centre_z + frame.point(place.origin)[2],
            com_vel_mps: vel,
            angvel_radps: frame.ang,
        };
        let f = water::forces(&params.water[i], &at, &params.surface);
        let spatial = add_cross(frame.bias_lin, frame.bias_ang, com);
        let classical = add_cross(spatial, frame.ang, vel);
        let mut drag = diagonal(&rot, scaled(f.damping_ns_per_m, dt));
        drag[5] += f.heave_ns_per_m * dt;
        let mass = diagonal(&rot, f.added_mass_kg);
        let drag_turn = diagonal(&rot, scaled(f.damping_nms_per_rad, dt));
        let inertia = diagonal(&rot, f.added_inertia_kgm2);
        let (mut linear, mut turning) = (mass, inertia);
        for c in 0..6 {
            linear[c] += drag[c];
            turning[c] += drag_turn[c];
        }
        let force = sub(add(sym_times(&mass, spatial), sym_times(&drag, classical)), f.force_n);
        let torque = sub(sym_times(&turning, frame.bias_ang), f.torque_nm);
        let to = &mut inertias[place.node];
        add_general(to, com, &linear);
        for c in 0..6 {
            to.a[c] += turning[c];
        }
        to.f = add(to.f, force);
        to.n = add(to.n, add(torque, cross(com, force)));
    }
}

#[inline(always)]
fn scaled<R: Lanes>(v: V3<R>, s: R) -> V3<R> {
    add_scaled([R::zero(); 3], v, s)
}

/// A diagonal tensor of the link's axes in the world.
#[inline(always)]
fn diagonal<R: Lanes>(rot: &[V3<R>; 3], d: V3<R>) -> [R; 6] {
    let o = R::zero();
    turn_sym(rot, &[d[0], o, o, d[1], o, d[2]])
}
