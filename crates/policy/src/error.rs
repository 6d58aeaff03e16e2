//! Why a policy file could not be written, read, accepted or run.

use std::path::PathBuf;

use thiserror::Error;

/// Errors of this crate.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// The file is larger than any policy.
    #[error("policy file has {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// Its size.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// Not protobuf.
    #[error("not an ONNX file: {problem} at byte {offset}")]
    Wire {
        /// Where.
        offset: usize,
        /// What is wrong.
        problem: &'static str,
    },
    /// A field written as another type than ONNX gives it.
    #[error("not an ONNX file: `{field}` of {message} has the wrong type")]
    WireType {
        /// Which ONNX message.
        message: &'static str,
        /// Which field of it.
        field: &'static str,
    },
    /// Text that is not UTF-8, or the like.
    #[error("not an ONNX file: {0}")]
    Malformed(String),
    /// A field that a policy has no use for.
    #[error("{message} holds field {number}, which a policy file does not have")]
    UnknownField {
        /// Which ONNX message.
        message: &'static str,
        /// Number of the field.
        number: u32,
    },
    /// A feature of ONNX that is refused: external data, functions, sub-graphs and the like.
    #[error("{message} holds `{field}`, which policy files must not")]
    Forbidden {
        /// Which ONNX message.
        message: &'static str,
        /// Which field of it.
        field: &'static str,
    },
    /// More of something than any policy has.
    #[error("{message} holds more than {limit} of `{field}`")]
    TooMany {
        /// Which ONNX message.
        message: &'static str,
        /// Which field of it.
        field: &'static str,
        /// The limit.
        limit: usize,
    },
    /// Another version of ONNX.
    #[error("{what} is {found}, policy files have {expected}")]
    Version {
        /// `ir_version` or `opset`.
        what: &'static str,
        /// Version in the file.
        found: i64,
        /// Version that is read.
        expected: i64,
    },
    /// Something that must be there is not.
    #[error("policy file lacks {what}")]
    Missing {
        /// What is missing.
        what: &'static str,
    },
    /// An operator of another domain.
    #[error("operator domain `{domain}` is not allowed in a policy")]
    Domain {
        /// The domain.
        domain: String,
    },
    /// An operator that policies do not use.
    #[error("operator `{operator}` is not allowed in a policy")]
    Operator {
        /// The operator.
        operator: String,
    },
    /// An attribute that the operator may not have here.
    #[error("operator {operator} has attributes that a policy does not use")]
    Attribute {
        /// The operator.
        operator: &'static str,
    },
    /// The operators are not the one chain that a policy is.
    #[error("node {node} of the graph: {problem}")]
    Chain {
        /// Which node, from 0.
        node: usize,
        /// What is wrong.
        problem: &'static str,
    },
    /// Two things of the same name.
    #[error("the graph names `{name}` twice")]
    DuplicateName {
        /// The name.
        name: String,
    },
    /// An operator reads a tensor that is not there.
    #[error("the graph has no tensor `{name}`")]
    MissingTensor {
        /// The name.
        name: String,
    },
    /// A tensor that no operator reads.
    #[error("tensor `{name}` is not used")]
    UnusedTensor {
        /// The name.
        name: String,
    },
    /// A tensor that is not of 32-bit floats.
    #[error("tensor `{name}` has data type {found}, policies hold 32-bit floats (1)")]
    TensorType {
        /// The tensor.
        name: String,
        /// Its ONNX data type; 0 where it has none.
        found: i32,
    },
    /// A tensor whose dimensions do not fit its place, or its own bytes.
    #[error("tensor `{name}` has dimensions {found:?}, {problem}")]
    TensorShape {
        /// The tensor.
        name: String,
        /// Its dimensions.
        found: Vec<i64>,
        /// Why they are wrong.
        problem: &'static str,
    },
    /// NaN or infinity in a tensor.
    #[error("tensor `{name}` holds a NaN or an infinity at index {index}")]
    NotFinite {
        /// The tensor.
        name: String,
        /// Where.
        index: usize,
    },
    /// A number out of its range.
    #[error("`{field}` is out of range: {problem}")]
    Range {
        /// Which number.
        field: &'static str,
        /// What it must be.
        problem: &'static str,
    },
    /// The graph's input or output is not what a policy has.
    #[error("`{tensor}` must be a 32-bit float tensor [N, {expected}]")]
    Signature {
        /// `obs` or `actions`.
        tensor: &'static str,
        /// Its second dimension.
        expected: usize,
    },
    /// A metadata key that is there twice; readers would disagree about which one counts.
    #[error("metadata key `{key}` is there twice")]
    DuplicateKey {
        /// The key.
        key: String,
    },
    /// A metadata key that must be there.
    #[error("policy file lacks metadata key `{key}`; was it written by caudata?")]
    MissingKey {
        /// The key.
        key: &'static str,
    },
    /// `caudata.policy.v1` is not the JSON that it should be.
    #[error("metadata `caudata.policy.v1`: {problem}")]
    Metadata {
        /// What is wrong.
        problem: String,
    },
    /// A key for other tools says something else than `caudata.policy.v1`.
    #[error("metadata key `{key}` contradicts `caudata.policy.v1`")]
    Contradiction {
        /// The key.
        key: &'static str,
    },
    /// Policies that have no mean.
    #[error(
        "only versions of one training, with one contract and one network, have a mean, and at least one must be left"
    )]
    NotOneTraining,
    /// Two policies that cannot be made into one.
    #[error("the policies cannot be joined: {problem}")]
    NotJoinable {
        /// Why not.
        problem: &'static str,
    },
    /// The policy is for another robot.
    #[error("policy is for robot `{found}`, this is `{expected}`")]
    WrongRobot {
        /// Robot of the policy.
        found: String,
        /// Robot here.
        expected: String,
    },
    /// The policy was trained on another version of the robot model.
    #[error(
        "policy was trained on model {found} of the robot, this one is {expected}; train on this model or use that one"
    )]
    WrongRobotModel {
        /// Hash in the policy, hexadecimal.
        found: String,
        /// Hash here.
        expected: String,
    },
    /// Other joints, or the same in another order.
    #[error("joint {index} is `{found}` in the policy and `{expected}` here")]
    WrongJointOrder {
        /// First joint that differs.
        index: usize,
        /// Its name in the policy.
        found: String,
        /// Its name here.
        expected: String,
    },
    /// A part of the contract differs.
    #[error("the policy differs from what is expected here in its {part}")]
    WrongPart {
        /// Which part.
        part: &'static str,
    },
    /// No ONNX Runtime where it is looked for.
    #[error(
        "no ONNX Runtime: {reason}; set ORT_DYLIB_PATH to libonnxruntime.so or run `make setup`"
    )]
    RuntimeNotFound {
        /// Where was looked.
        reason: String,
    },
    /// The library is there and does not load.
    #[error("cannot load ONNX Runtime from {}: {reason}", path.display())]
    RuntimeLoad {
        /// The library.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// ONNX Runtime refused the model or failed to run it.
    #[error("ONNX Runtime: {0}")]
    Runtime(String),
    /// A slice of the wrong length was handed over.
    #[error("`{what}` has {found} numbers, must have {expected}")]
    Length {
        /// Which slice.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The right length.
        expected: usize,
    },
}
