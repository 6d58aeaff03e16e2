//! From a network and its metadata to the bytes of a policy file.

use prost::Message;

use super::messages::{
    Attribute, AttributeKind, Dimension, Extent, FLOAT, Graph, Model, Node, OperatorSet, Property,
    Shape, Tensor, TensorType, Type, ValueInfo,
};
use super::{BATCH, INPUT, IR_VERSION, OPSET, OUTPUT};
use crate::metadata::PolicyMetadata;
use crate::mlp::{Activation, MlpSpec, bias_name, weight_name};
use crate::{MAX_FILE_BYTES, PolicyError};

/// The bytes of a policy file. The same network and metadata give the same bytes.
///
/// # Errors
/// What [`MlpSpec::check`] or the metadata's check refuses; a network whose sizes are not those of
/// the contract; [`PolicyError::TooLarge`].
pub fn build_onnx(spec: &MlpSpec, metadata: &PolicyMetadata) -> Result<Vec<u8>, PolicyError> {
    spec.check()?;
    metadata.check()?;
    metadata.check_sizes(spec)?;
    let property =
        |(key, value): (&str, String)| Property { key: Some(key.to_owned()), value: Some(value) };
    let model = Model {
        ir_version: Some(IR_VERSION),
        producer_name: Some("caudata".to_owned()),
        producer_version: Some(env!("CARGO_PKG_VERSION").to_owned()),
        graph: Some(graph(spec)),
        opset_import: vec![OperatorSet { domain: None, version: Some(OPSET) }],
        metadata_props: metadata.properties()?.into_iter().map(property).collect(),
    };
    let bytes = model.encode_to_vec();
    if bytes.len() > MAX_FILE_BYTES {
        return Err(PolicyError::TooLarge { bytes: bytes.len(), limit: MAX_FILE_BYTES });
    }
    Ok(bytes)
}

fn graph(spec: &MlpSpec) -> Graph {
    let mut chain = Chain { node: Vec::new(), initializer: Vec::new(), current: INPUT.to_owned() };
    let obs_dim = spec.obs_dim();
    chain.with_parameter("Sub", "centred", ("obs_mean", &[obs_dim], &spec.obs_mean));
    chain.with_parameter("Div", "normalised", ("obs_std", &[obs_dim], &spec.obs_std));
    if let Some(clip) = spec.obs_clip {
        let low = chain.parameter("obs_clip_min", &[], &[-clip]);
        let high = chain.parameter("obs_clip_max", &[], &[clip]);
        chain.push("Clip", "clipped", vec![low, high]);
    }
    for (index, layer) in spec.layers.iter().enumerate() {
        let last = index + 1 == spec.layers.len();
        let weight = chain.parameter(&weight_name(index), &[layer.out, layer.input], &layer.weight);
        let bias = chain.parameter(&bias_name(index), &[layer.out], &layer.bias);
        let output = if last { OUTPUT.to_owned() } else { format!("layers.{index}.linear") };
        chain.push("Gemm", &output, vec![weight, bias]);
        if !last {
            chain.activation(spec.activation, index);
        }
    }
    Graph {
        node: chain.node,
        name: Some("policy".to_owned()),
        initializer: chain.initializer,
        input: vec![value_info(INPUT, obs_dim)],
        output: vec![value_info(OUTPUT, spec.act_dim())],
    }
}

/// A graph in which each operator works on the result of the one before.
struct Chain {
    node: Vec<Node>,
    initializer: Vec<Tensor>,
    current: String,
}

impl Chain {
    /// Appends an operator on the current value and `more` inputs; its result becomes current.
    fn push(&mut self, operator: &str, output: &str, more: Vec<String>) {
        let mut input = vec![self.current.clone()];
        input.extend(more);
        self.node.push(Node {
            input,
            output: vec![output.to_owned()],
            name: Some(format!("{}_{}", operator.to_lowercase(), self.node.len())),
            op_type: Some(operator.to_owned()),
            // Weights are [out, in], so that a layer is y = x Wᵀ + b.
            attribute: if operator == "Gemm" { vec![transposed_weight()] } else { Vec::new() },
            domain: None,
        });
        self.current = output.to_owned();
    }

    fn with_parameter(&mut self, operator: &str, output: &str, p: (&str, &[usize], &[f32])) {
        let name = self.parameter(p.0, p.1, p.2);
        self.push(operator, output, vec![name]);
    }

    fn parameter(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        self.initializer.push(Tensor {
            dims: dims.iter().map(|&d| d as i64).collect(),
            data_type: Some(FLOAT),
            name: Some(name.to_owned()),
            raw_data: Some(values.iter().flat_map(|x| x.to_le_bytes()).collect()),
        });
        name.to_owned()
    }

    fn activation(&mut self, activation: Activation, index: usize) {
        let output = format!("layers.{index}.activation");
        match activation {
            Activation::Elu => self.push("Elu", &output, Vec::new()),
            Activation::Tanh => self.push("Tanh", &output, Vec::new()),
            Activation::Relu => self.push("Relu", &output, Vec::new()),
            Activation::Swish => {
                let linear = self.current.clone();
                let gate = format!("layers.{index}.gate");
                self.push("Sigmoid", &gate, Vec::new());
                self.current = linear;
                self.push("Mul", &output, vec![gate]);
            }
        }
    }
}

pub(super) fn transposed_weight() -> Attribute {
    Attribute { name: Some("transB".to_owned()), i: Some(1), kind: Some(AttributeKind::Int.into()) }
}

/// A tensor of floats `[N, width]`.
pub(super) fn value_info(name: &str, width: usize) -> ValueInfo {
    let dim = vec![
        Dimension { extent: Some(Extent::Parameter(BATCH.to_owned())) },
        Dimension { extent: Some(Extent::Value(width as i64)) },
    ];
    let tensor = TensorType { elem_type: Some(FLOAT), shape: Some(Shape { dim }) };
    ValueInfo { name: Some(name.to_owned()), kind: Some(Type { tensor: Some(tensor) }) }
}
