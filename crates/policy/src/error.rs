//! Why a policy file could not be written, read, accepted or run.

use std::path::PathBuf;

use thiserror::Error;

/// Errors of this crate.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum PolicyError {
    /// The file is larger than any policy.
    #[error("policy file has {bytes} bytes, the limit is {limit}")]
    TooLarge { bytes: usize, limit: usize },
    /// Not protobuf.
    #[error("not an ONNX file: {problem} at byte {offset}")]
    Wire { offset: usize, problem: &'static str },
    /// A field written as another type than ONNX gives it.
    #[error("not an ONNX file: `{field}` of {message} has the wrong type")]
    WireType { message: &'static str, field: &'static str },
    /// Text that is not UTF-8, or the like.
    #[error("not an ONNX file: {0}")]
    Malformed(String),
    /// A field that a policy has no use for.
    #[error("{message} holds field {number}, which a policy file does not have")]
    UnknownField { message: &'static str, number: u32 },
    /// A feature of ONNX that is refused: external data, functions, sub-graphs and the like.
    #[error("{message} holds `{field}`, which policy files must not")]
    Forbidden { message: &'static str, field: &'static str },
    /// More of something than any policy has.
    #[error("{message} holds more than {limit} of `{field}`")]
    TooMany { message: &'static str, field: &'static str, limit: usize },
    /// Another version of ONNX.
    #[error("{what} is {found}, policy files have {expected}")]
    Version { what: &'static str, found: i64, expected: i64 },
    /// Something that must be there is not.
    #[error("policy file lacks {what}")]
    Missing { what: &'static str },
    /// An operator of another domain.
    #[error("operator domain `{domain}` is not allowed in a policy")]
    Domain { domain: String },
    /// An operator that policies do not use.
    #[error("operator `{operator}` is not allowed in a policy")]
    Operator { operator: String },
    /// An attribute that the operator may not have here.
    #[error("operator {operator} has attributes that a policy does not use")]
    Attribute { operator: &'static str },
    /// The operators are not the one chain that a policy is.
    #[error("node {node} of the graph: {problem}")]
    Chain { node: usize, problem: &'static str },
    /// Two things of the same name.
    #[error("the graph names `{name}` twice")]
    DuplicateName { name: String },
    /// An operator reads a tensor that is not there.
    #[error("the graph has no tensor `{name}`")]
    MissingTensor { name: String },
    /// A tensor that no operator reads.
    #[error("tensor `{name}` is not used")]
    UnusedTensor { name: String },
    /// A tensor that is not of 32-bit floats.
    #[error("tensor `{name}` has data type {found}, policies hold 32-bit floats (1)")]
    TensorType { name: String, found: i32 },
    /// A tensor whose dimensions do not fit its place, or its own bytes.
    #[error("tensor `{name}` has dimensions {found:?}, {problem}")]
    TensorShape { name: String, found: Vec<i64>, problem: &'static str },
    /// NaN or infinity in a tensor.
    #[error("tensor `{name}` holds a NaN or an infinity at index {index}")]
    NotFinite { name: String, index: usize },
    /// A number out of its range.
    #[error("`{field}` is out of range: {problem}")]
    Range { field: &'static str, problem: &'static str },
    /// The graph's input or output is not what a policy has.
    #[error("`{tensor}` must be a 32-bit float tensor [N, {expected}]")]
    Signature { tensor: &'static str, expected: usize },
    /// A metadata key that is there twice; readers would disagree about which one counts.
    #[error("metadata key `{key}` is there twice")]
    DuplicateKey { key: String },
    /// A metadata key that must be there.
    #[error("policy file lacks metadata key `{key}`; was it written by caudata?")]
    MissingKey { key: &'static str },
    /// `caudata.policy.v1` is not the JSON that it should be.
    #[error("metadata `caudata.policy.v1`: {problem}")]
    Metadata { problem: String },
    /// A key for other tools says something else than `caudata.policy.v1`.
    #[error("metadata key `{key}` contradicts `caudata.policy.v1`")]
    Contradiction { key: &'static str },
    /// Policies that have no mean.
    #[error(
        "only versions of one training, with one contract and one network, have a mean, and at least one must be left"
    )]
    NotOneTraining,
    /// Two policies that cannot be made into one.
    #[error("the policies cannot be joined: {problem}")]
    NotJoinable { problem: &'static str },
    /// The policy is for another robot.
    #[error("policy is for robot `{found}`, this is `{expected}`")]
    WrongRobot { found: String, expected: String },
    /// The policy was trained on another version of the robot model.
    #[error(
        "policy was trained on model {found} of the robot, this one is {expected}; train on this model or use that one"
    )]
    WrongRobotModel { found: String, expected: String },
    /// Other joints, or the same in another order.
    #[error("joint {index} is `{found}` in the policy and `{expected}` here")]
    WrongJointOrder { index: usize, found: String, expected: String },
    /// A part of the contract differs.
    #[error("the policy differs from what is expected here in its {part}")]
    WrongPart { part: &'static str },
    /// No ONNX Runtime where it is looked for.
    #[error(
        "no ONNX Runtime: {reason}; set ORT_DYLIB_PATH to libonnxruntime.so or run `make setup`"
    )]
    RuntimeNotFound { reason: String },
    /// The library is there and does not load.
    #[error("cannot load ONNX Runtime from {}: {reason}", path.display())]
    RuntimeLoad { path: PathBuf, reason: String },
    /// ONNX Runtime refused the model or failed to run it.
    #[error("ONNX Runtime: {0}")]
    Runtime(String),
    /// A slice of the wrong length was handed over.
    #[error("`{what}` has {found} numbers, must have {expected}")]
    Length { what: &'static str, found: usize, expected: usize },
}
