//! Vector lanes that are found at run time, and what is written over them for more than one part: [`real`] (the
//! number type that physics is written over), [`simd`] (vector registers), [`dense`], [`fold`] and
//! [`perceptron`] (layers of networks).
//!
//! *Invariant:* the only `unsafe` code of physics and networks is here.

pub mod dense;
pub mod fold;
pub mod perceptron;
pub mod real;
pub mod simd;
