//! Second pass over a policy file: the graph must be the one chain of operators of a policy.

use std::collections::{BTreeMap, BTreeSet};

use prost::Message;

use super::build::{transposed_weight, value_info};
use super::messages::{FLOAT, Graph, Model, Node, Tensor};
use super::{INPUT, IR_VERSION, OPSET, OUTPUT, scan};
use crate::PolicyError;
use crate::mlp::{Activation, Dense, MAX_WIDTH, MlpSpec, finite};

/// Operators that a policy may use.
const OPERATORS: [&str; 9] =
    ["Sub", "Div", "Clip", "Gemm", "Elu", "Tanh", "Relu", "Sigmoid", "Mul"];

/// The network and the metadata properties of a file, all checks of the file's form done.
pub(crate) fn read(bytes: &[u8]) -> Result<(MlpSpec, BTreeMap<String, String>), PolicyError> {
    scan::scan(bytes)?;
    let model = Model::decode(bytes).map_err(|e| PolicyError::Malformed(e.to_string()))?;
    version("ir_version", model.ir_version, IR_VERSION)?;
    let opset = model.opset_import.first().ok_or(PolicyError::Missing { what: "an opset" })?;
    standard_domain(opset.domain.as_deref())?;
    version("opset", opset.version, OPSET)?;
    let properties = properties(&model)?;
    let graph = model.graph.ok_or(PolicyError::Missing { what: "a graph" })?;
    let spec = network(&graph)?;
    spec.check()?;
    Ok((spec, properties))
}

fn version(what: &'static str, found: Option<i64>, expected: i64) -> Result<(), PolicyError> {
    let found = found.unwrap_or(0);
    if found == expected {
        return Ok(());
    }
    Err(PolicyError::Version { what, found, expected })
}

fn standard_domain(domain: Option<&str>) -> Result<(), PolicyError> {
    match domain.unwrap_or("") {
        "" => Ok(()),
        other => Err(PolicyError::Domain { domain: other.to_owned() }),
    }
}

fn properties(model: &Model) -> Result<BTreeMap<String, String>, PolicyError> {
    let mut properties = BTreeMap::new();
    for property in &model.metadata_props {
        let key = property.key.clone().unwrap_or_default();
        let value = property.value.clone().unwrap_or_default();
        if properties.insert(key.clone(), value).is_some() {
            return Err(PolicyError::DuplicateKey { key });
        }
    }
    Ok(properties)
}

/// Follows the chain from `obs` to `actions`.
fn network(graph: &Graph) -> Result<MlpSpec, PolicyError> {
    check_operators(&graph.node)?;
    check_names(graph)?;
    let mut walk = Walk::new(graph)?;
    let obs_mean = walk.vector_step("Sub")?;
    let obs_std = walk.vector_step("Div")?;
    let obs_clip = walk.clip_step()?;
    let (mut layers, mut activation) = (Vec::new(), None);
    loop {
        layers.push(walk.gemm_step()?);
        if walk.at == graph.node.len() {
            break;
        }
        let next = walk.activation_step()?;
        if activation.is_some_and(|a| a != next) {
            return Err(PolicyError::Chain {
                node: walk.at - 1,
                problem: "another activation than before",
            });
        }
        activation = Some(next);
    }
    walk.finish()?;
    let spec = MlpSpec {
        obs_mean,
        obs_std,
        obs_clip,
        layers,
        // One layer alone has no activation; any will do.
        activation: activation.unwrap_or(Activation::Elu),
    };
    check_signature(graph, &spec)?;
    Ok(spec)
}

fn check_operators(nodes: &[Node]) -> Result<(), PolicyError> {
    for node in nodes {
        standard_domain(node.domain.as_deref())?;
        let operator = node.op_type.as_deref().unwrap_or("");
        let Some(operator) = OPERATORS.into_iter().find(|&o| o == operator) else {
            return Err(PolicyError::Operator { operator: operator.to_owned() });
        };
        let expected = if operator == "Gemm" { vec![transposed_weight()] } else { Vec::new() };
        if node.attribute != expected {
            return Err(PolicyError::Attribute { operator });
        }
    }
    Ok(())
}

/// Every value (input, parameter, result) has a name of its own.
fn check_names(graph: &Graph) -> Result<(), PolicyError> {
    let inputs = graph.input.iter().map(|v| v.name.as_deref());
    let parameters = graph.initializer.iter().map(|t| t.name.as_deref());
    let results = graph.node.iter().flat_map(|n| n.output.iter().map(|o| Some(o.as_str())));
    let mut seen = BTreeSet::new();
    for name in inputs.chain(parameters).chain(results) {
        let name = name.unwrap_or("");
        if name.is_empty() {
            return Err(PolicyError::Missing { what: "the name of a tensor" });
        }
        if !seen.insert(name) {
            return Err(PolicyError::DuplicateName { name: name.to_owned() });
        }
    }
    Ok(())
}

fn check_signature(graph: &Graph, spec: &MlpSpec) -> Result<(), PolicyError> {
    let expect = |found: &[_], tensor, width| {
        if found == [value_info(tensor, width)] {
            return Ok(());
        }
        Err(PolicyError::Signature { tensor, expected: width })
    };
    expect(&graph.input, INPUT, spec.obs_dim())?;
    expect(&graph.output, OUTPUT, spec.act_dim())
}

/// A walk along the nodes. The file must list them in the order of the chain, which ONNX asks of
/// every graph (topological order) and which makes cycles and side branches impossible.
struct Walk<'a> {
    nodes: &'a [Node],
    at: usize,
    current: &'a str,
    /// Parameters that no node has read yet.
    parameters: BTreeMap<&'a str, Parameter<'a>>,
}

struct Parameter<'a> {
    dims: &'a [i64],
    values: Vec<f32>,
}

impl<'a> Walk<'a> {
    fn new(graph: &'a Graph) -> Result<Self, PolicyError> {
        let mut parameters = BTreeMap::new();
        for tensor in &graph.initializer {
            let name = tensor.name.as_deref().unwrap_or("");
            parameters.insert(name, parameter(name, tensor)?);
        }
        Ok(Self { nodes: &graph.node, at: 0, current: INPUT, parameters })
    }

    fn fail(&self, problem: &'static str) -> PolicyError {
        PolicyError::Chain { node: self.at, problem }
    }

    /// The next node, which must be `operator` on the current value with `K` more inputs. Its
    /// result becomes the current value.
    fn step<const K: usize>(&mut self, operator: &str) -> Result<[&'a str; K], PolicyError> {
        let nodes = self.nodes;
        let Some(node) = nodes.get(self.at) else {
            return Err(self.fail("the chain ends too early"));
        };
        if node.op_type.as_deref() != Some(operator) {
            return Err(self.fail("not the operator that belongs here"));
        }
        let Some((first, more)) = node.input.split_first() else {
            return Err(self.fail("no input"));
        };
        if first != self.current {
            return Err(self.fail("does not work on the result of the node before"));
        }
        if more.len() != K {
            return Err(self.fail("the wrong number of inputs"));
        }
        let [output] = node.output.as_slice() else { return Err(self.fail("no output")) };
        self.at += 1;
        self.current = output;
        Ok(std::array::from_fn(|i| more[i].as_str()))
    }

    /// Takes a parameter out: each belongs to one node only.
    fn take(&mut self, name: &str) -> Result<Parameter<'a>, PolicyError> {
        let missing = || PolicyError::MissingTensor { name: name.to_owned() };
        self.parameters.remove(name).ok_or_else(missing)
    }

    /// `Sub` or `Div` by a vector.
    fn vector_step(&mut self, operator: &str) -> Result<Vec<f32>, PolicyError> {
        let [name] = self.step(operator)?;
        let parameter = self.take(name)?;
        if parameter.dims.len() != 1 {
            return Err(wrong_shape(name, parameter.dims, "must be [D]"));
        }
        Ok(parameter.values)
    }

    /// `Clip`, where there is one, to a symmetric range.
    fn clip_step(&mut self) -> Result<Option<f32>, PolicyError> {
        if self.nodes.get(self.at).and_then(|n| n.op_type.as_deref()) != Some("Clip") {
            return Ok(None);
        }
        let [low_name, high_name] = self.step("Clip")?;
        let (low, high) = (self.take(low_name)?, self.take(high_name)?);
        for (name, parameter) in [(low_name, &low), (high_name, &high)] {
            if !parameter.dims.is_empty() {
                return Err(wrong_shape(name, parameter.dims, "must be a scalar"));
            }
        }
        if low.values[0] != -high.values[0] {
            return Err(PolicyError::Range { field: "obs_clip", problem: "symmetric" });
        }
        Ok(Some(high.values[0]))
    }

    fn gemm_step(&mut self) -> Result<Dense, PolicyError> {
        let [weight_name, bias_name] = self.step("Gemm")?;
        let (weight, bias) = (self.take(weight_name)?, self.take(bias_name)?);
        let &[out, input] = weight.dims else {
            return Err(wrong_shape(weight_name, weight.dims, "must be [out, in]"));
        };
        if bias.dims != [out] {
            return Err(wrong_shape(bias_name, bias.dims, "must be [out]"));
        }
        // Positive and at most MAX_WIDTH: `parameter` saw to it.
        Ok(Dense {
            out: out as usize,
            input: input as usize,
            weight: weight.values,
            bias: bias.values,
        })
    }

    fn activation_step(&mut self) -> Result<Activation, PolicyError> {
        let linear = self.current;
        let (operator, activation) = match self.nodes[self.at].op_type.as_deref() {
            Some("Elu") => ("Elu", Activation::Elu),
            Some("Tanh") => ("Tanh", Activation::Tanh),
            Some("Relu") => ("Relu", Activation::Relu),
            Some("Sigmoid") => ("Sigmoid", Activation::Swish),
            _ => return Err(self.fail("an activation belongs here")),
        };
        let [] = self.step(operator)?;
        if activation == Activation::Swish {
            let gate = self.current;
            self.current = linear;
            let [factor] = self.step("Mul")?;
            if factor != gate {
                self.at -= 1;
                return Err(self.fail("Mul must multiply by the Sigmoid before it"));
            }
        }
        Ok(activation)
    }

    fn finish(&self) -> Result<(), PolicyError> {
        if self.current != OUTPUT {
            return Err(PolicyError::Chain {
                node: self.at - 1,
                problem: "the last node must give `actions`",
            });
        }
        match self.parameters.keys().next() {
            None => Ok(()),
            Some(name) => Err(PolicyError::UnusedTensor { name: (*name).to_owned() }),
        }
    }
}

fn wrong_shape(name: &str, dims: &[i64], problem: &'static str) -> PolicyError {
    PolicyError::TensorShape { name: name.to_owned(), found: dims.to_vec(), problem }
}

/// A parameter's values: floats, as many as its dimensions say, finite.
fn parameter<'a>(name: &str, tensor: &'a Tensor) -> Result<Parameter<'a>, PolicyError> {
    let found = tensor.data_type.unwrap_or(0);
    if found != FLOAT {
        return Err(PolicyError::TensorType { name: name.to_owned(), found });
    }
    let mut count = 1_usize;
    for &dim in &tensor.dims {
        if !(1..=MAX_WIDTH as i64).contains(&dim) {
            return Err(wrong_shape(name, &tensor.dims, "each must be 1 to 4096"));
        }
        // At most two dimensions of at most 4096: no overflow.
        count *= dim as usize;
    }
    let bytes = tensor.raw_data.as_deref().unwrap_or(&[]);
    if bytes.len() != count * 4 {
        return Err(wrong_shape(name, &tensor.dims, "which its bytes do not match"));
    }
    let (words, _) = bytes.as_chunks::<4>();
    let values: Vec<f32> = words.iter().map(|&word| f32::from_le_bytes(word)).collect();
    finite(name, &values)?;
    Ok(Parameter { dims: &tensor.dims, values })
}
