//! Files that were tampered with: each trick by the name of its refusal.

use proptest::prelude::*;
use prost::Message;

use super::{bytes, file, network, small};
use crate::onnx::messages::{Attribute, Extent, Model, Node, Property, Tensor};
use crate::{Activation, METADATA_KEY, PolicyError, PolicyFile};

fn model() -> Model {
    Model::decode(&*bytes(&small())).unwrap()
}

/// Why a changed model is refused.
fn refused(change: impl FnOnce(&mut Model)) -> PolicyError {
    let mut model = model();
    change(&mut model);
    PolicyFile::parse(model.encode_to_vec().into()).unwrap_err()
}

fn nodes(model: &mut Model) -> &mut Vec<Node> {
    &mut model.graph.as_mut().unwrap().node
}

fn tensors(model: &mut Model) -> &mut Vec<Tensor> {
    &mut model.graph.as_mut().unwrap().initializer
}

fn tensor<'a>(model: &'a mut Model, name: &str) -> &'a mut Tensor {
    tensors(model).iter_mut().find(|t| t.name.as_deref() == Some(name)).unwrap()
}

fn property<'a>(model: &'a mut Model, key: &str) -> &'a mut Property {
    model.metadata_props.iter_mut().find(|p| p.key.as_deref() == Some(key)).unwrap()
}

#[test]
fn an_untouched_model_is_written_back_as_the_same_bytes() {
    // Without this, the tests below could pass for a reason other than theirs.
    assert_eq!(model().encode_to_vec(), bytes(&small()).to_vec());
    // Sub, Div, Clip, Gemm, Sigmoid, Mul, Gemm.
    let operators: Vec<_> =
        model().graph.unwrap().node.into_iter().map(|n| n.op_type.unwrap()).collect();
    assert_eq!(operators, ["Sub", "Div", "Clip", "Gemm", "Sigmoid", "Mul", "Gemm"]);
}

#[test]
fn other_versions_domains_and_operators() {
    let version = |e: PolicyError| match e {
        PolicyError::Version { what, found, .. } => (what, found),
        other => panic!("{other}"),
    };
    assert_eq!(version(refused(|m| m.ir_version = Some(9))), ("ir_version", 9));
    assert_eq!(version(refused(|m| m.ir_version = None)), ("ir_version", 0));
    assert_eq!(version(refused(|m| m.opset_import[0].version = Some(-17))), ("opset", -17));
    let none = refused(|m| m.opset_import.clear());
    assert_eq!(none, PolicyError::Missing { what: "an opset" });
    let many = refused(|m| m.opset_import.push(m.opset_import[0].clone()));
    assert!(matches!(many, PolicyError::TooMany { field: "opset_import", .. }), "{many}");
    let domain = refused(|m| nodes(m)[3].domain = Some("com.microsoft".into()));
    assert_eq!(domain, PolicyError::Domain { domain: "com.microsoft".into() });
    let domain = refused(|m| m.opset_import[0].domain = Some("ai.onnx.ml".into()));
    assert_eq!(domain, PolicyError::Domain { domain: "ai.onnx.ml".into() });
    for operator in ["If", "Loop", "Scan", "gemm", ""] {
        let error = refused(|m| nodes(m)[3].op_type = Some(operator.into()));
        assert_eq!(error, PolicyError::Operator { operator: operator.into() });
    }
    let none = refused(|m| nodes(m)[3].op_type = None);
    assert_eq!(none, PolicyError::Operator { operator: String::new() });
}

#[test]
fn attributes() {
    let gemm = PolicyError::Attribute { operator: "Gemm" };
    assert_eq!(refused(|m| nodes(m)[3].attribute.clear()), gemm);
    assert_eq!(refused(|m| nodes(m)[3].attribute[0].i = Some(0)), gemm);
    assert_eq!(refused(|m| nodes(m)[3].attribute[0].name = Some("transA".into())), gemm);
    let alpha = Attribute { name: Some("alpha".into()), i: Some(2), kind: Some(2) };
    let sigmoid = refused(|m| nodes(m)[4].attribute.push(alpha));
    assert_eq!(sigmoid, PolicyError::Attribute { operator: "Sigmoid" });
}

#[test]
fn chains_that_are_not_the_one() {
    let chain = |e: PolicyError| match e {
        PolicyError::Chain { node, problem } => (node, problem),
        other => panic!("{other}"),
    };
    let not_here = "not the operator that belongs here";
    assert_eq!(chain(refused(|m| nodes(m).swap(0, 1))), (0, not_here));
    assert_eq!(chain(refused(|m| nodes(m)[1].op_type = Some("Sub".into()))), (1, not_here));
    assert_eq!(chain(refused(|m| nodes(m).truncate(0))), (0, "the chain ends too early"));
    assert_eq!(
        chain(refused(|m| nodes(m)[3].input[0] = "obs".into())),
        (3, "does not work on the result of the node before")
    );
    // A cycle: the first node reads the last one's result.
    assert_eq!(
        chain(refused(|m| nodes(m)[0].input[0] = "actions".into())),
        (0, "does not work on the result of the node before")
    );
    assert_eq!(
        chain(refused(|m| nodes(m)[3].input.truncate(2))),
        (3, "the wrong number of inputs")
    );
    assert_eq!(chain(refused(|m| nodes(m)[3].input.clear())), (3, "no input"));
    assert_eq!(chain(refused(|m| nodes(m)[3].output.clear())), (3, "no output"));
    assert_eq!(
        chain(refused(|m| {
            nodes(m)[4].op_type = Some("Gemm".into());
            nodes(m)[4].attribute = nodes(m)[3].attribute.clone();
        })),
        (4, "an activation belongs here")
    );
    let mut mixed = Model::decode(&*bytes(&network(&[2, 2], Activation::Tanh, None))).unwrap();
    // Sub, Div, Gemm, Tanh, Gemm, Tanh, Gemm.
    nodes(&mut mixed)[5].op_type = Some("Relu".into());
    assert_eq!(
        chain(PolicyFile::parse(mixed.encode_to_vec().into()).unwrap_err()),
        (5, "another activation than before")
    );
    assert_eq!(
        chain(refused(|m| nodes(m)[5].input[1] = "clipped".into())),
        (5, "Mul must multiply by the Sigmoid before it")
    );
    assert_eq!(
        chain(refused(|m| nodes(m)[6].output[0] = "other".into())),
        (6, "the last node must give `actions`")
    );
    assert_eq!(
        chain(refused(|m| {
            let mut more = nodes(m)[4].clone();
            more.input[0] = "actions".into();
            more.output[0] = "more".into();
            nodes(m).push(more);
        })),
        (8, "the chain ends too early"),
        "an activation after the actions"
    );
}

#[test]
fn names() {
    let twice = refused(|m| nodes(m)[1].output[0] = "centred".into());
    assert_eq!(twice, PolicyError::DuplicateName { name: "centred".into() });
    let shadow = refused(|m| tensor(m, "obs_std").name = Some("obs".into()));
    assert_eq!(shadow, PolicyError::DuplicateName { name: "obs".into() });
    let doubled = refused(|m| {
        let copy = tensors(m)[0].clone();
        tensors(m).push(copy);
    });
    assert_eq!(doubled, PolicyError::DuplicateName { name: "obs_mean".into() });
    let nameless = refused(|m| tensor(m, "obs_std").name = None);
    assert_eq!(nameless, PolicyError::Missing { what: "the name of a tensor" });
    let missing = refused(|m| tensors(m).retain(|t| t.name.as_deref() != Some("obs_std")));
    assert_eq!(missing, PolicyError::MissingTensor { name: "obs_std".into() });
    let unused = refused(|m| {
        let mut extra = tensors(m)[0].clone();
        extra.name = Some("extra".into());
        tensors(m).push(extra);
    });
    assert_eq!(unused, PolicyError::UnusedTensor { name: "extra".into() });
    let shared = refused(|m| nodes(m)[1].input[1] = "obs_mean".into());
    assert_eq!(shared, PolicyError::MissingTensor { name: "obs_mean".into() });
}

#[test]
fn tensors_of_the_wrong_type_size_or_value() {
    // 10 is fp16, 11 double, 0 undefined.
    for found in [0, 10, 11] {
        let error = refused(|m| tensor(m, "obs_mean").data_type = Some(found));
        assert_eq!(error, PolicyError::TensorType { name: "obs_mean".into(), found });
    }
    let shape = |e: PolicyError| match e {
        PolicyError::TensorShape { problem, .. } => problem,
        other => panic!("{other}"),
    };
    for bad in [0, -1, 4097, i64::MAX, i64::MIN] {
        let error = refused(|m| tensor(m, "layers.0.weight").dims[0] = bad);
        assert_eq!(shape(error), "each must be 1 to 4096", "{bad}");
    }
    // 2^32 · 2^32 wraps to 0 elements.
    let wrap = refused(|m| {
        let t = tensor(m, "layers.0.weight");
        t.dims = vec![1 << 32, 1 << 32];
        t.raw_data = None;
    });
    assert_eq!(shape(wrap), "each must be 1 to 4096");
    let short = refused(|m| tensor(m, "obs_mean").raw_data.as_mut().unwrap().truncate(4));
    assert_eq!(shape(short), "which its bytes do not match");
    let none = refused(|m| tensor(m, "obs_mean").raw_data = None);
    assert_eq!(shape(none), "which its bytes do not match");
    let flat = refused(|m| tensor(m, "layers.0.weight").dims = vec![194]);
    assert_eq!(shape(flat), "must be [out, in]");
    let turned = refused(|m| tensor(m, "obs_mean").dims = vec![1, 97]);
    assert_eq!(shape(turned), "must be [D]");
    let bias = refused(|m| tensor(m, "layers.0.bias").dims = vec![1, 2]);
    assert_eq!(shape(bias), "must be [out]");
    let vector = refused(|m| tensor(m, "obs_clip_min").dims = vec![1]);
    assert_eq!(shape(vector), "must be a scalar");
    let deep = refused(|m| tensor(m, "obs_mean").dims = vec![97, 1, 1]);
    assert!(matches!(deep, PolicyError::TooMany { field: "dims", limit: 2, .. }), "{deep}");

    let put = |t: &mut Tensor, x: f32| {
        t.raw_data.as_mut().unwrap()[..4].copy_from_slice(&x.to_le_bytes());
    };
    let nan = refused(|m| put(tensor(m, "layers.1.weight"), f32::NAN));
    assert_eq!(nan, PolicyError::NotFinite { name: "layers.1.weight".into(), index: 0 });
    let zero = refused(|m| put(tensor(m, "obs_std"), 0.0));
    assert!(matches!(zero, PolicyError::Range { field: "obs_std", .. }), "{zero}");
    let skew = refused(|m| put(tensor(m, "obs_clip_min"), -4.0));
    assert!(matches!(skew, PolicyError::Range { field: "obs_clip", .. }), "{skew}");
    // Minimum above maximum: symmetric, and still no range.
    let inverted = refused(|m| {
        put(tensor(m, "obs_clip_min"), 5.0);
        put(tensor(m, "obs_clip_max"), -5.0);
    });
    assert!(matches!(inverted, PolicyError::Range { field: "obs_clip", .. }), "{inverted}");
}

#[test]
fn inputs_and_outputs_of_another_shape() {
    let input = PolicyError::Signature { tensor: "obs", expected: 97 };
    let output = PolicyError::Signature { tensor: "actions", expected: 16 };
    fn io(model: &mut Model, out: bool) -> &mut crate::onnx::messages::TensorType {
        let graph = model.graph.as_mut().unwrap();
        let list = if out { &mut graph.output } else { &mut graph.input };
        list[0].kind.as_mut().unwrap().tensor.as_mut().unwrap()
    }
    fn dims(model: &mut Model, out: bool) -> &mut Vec<crate::onnx::messages::Dimension> {
        &mut io(model, out).shape.as_mut().unwrap().dim
    }
    assert_eq!(refused(|m| dims(m, false)[1].extent = Some(Extent::Value(98))), input);
    assert_eq!(refused(|m| dims(m, false)[0].extent = Some(Extent::Value(1))), input);
    assert_eq!(refused(|m| dims(m, true)[1].extent = Some(Extent::Value(-16))), output);
    assert_eq!(refused(|m| io(m, true).elem_type = Some(11)), output);
    assert_eq!(refused(|m| io(m, false).shape = None), input);
    assert_eq!(refused(|m| m.graph.as_mut().unwrap().output.clear()), output);
    let second = refused(|m| {
        let graph = m.graph.as_mut().unwrap();
        let mut copy = graph.output[0].clone();
        copy.name = Some("normalised".into());
        graph.output.push(copy);
    });
    assert!(matches!(second, PolicyError::TooMany { field: "output", .. }), "{second}");
}

#[test]
fn metadata_that_lies() {
    let twice = refused(|m| {
        let copy = property(m, METADATA_KEY).clone();
        m.metadata_props.push(copy);
    });
    assert_eq!(twice, PolicyError::DuplicateKey { key: METADATA_KEY.into() });
    let key = |m: &mut Model, key: &str| property(m, key).key = Some("other".into());
    assert_eq!(refused(|m| key(m, METADATA_KEY)), PolicyError::MissingKey { key: METADATA_KEY });
    assert_eq!(refused(|m| key(m, "joint_names")), PolicyError::MissingKey { key: "joint_names" });
    assert_eq!(
        refused(|m| property(m, "joint_stiffness").value = Some("16".into())),
        PolicyError::Contradiction { key: "joint_stiffness" }
    );
    let edit = |from: &'static str, to: &'static str| {
        refused(move |m| {
            let json = property(m, METADATA_KEY).value.as_mut().unwrap();
            assert!(json.contains(from), "{from}");
            *json = json.replacen(from, to, 1);
        })
    };
    for error in [
        edit("{", "["),
        edit("\"version\":41", "\"version\":-41"),
        edit("\"version\":41", "\"version\":41,\"version\":42"),
        edit("\"version\":41", "\"version\":41,\"surprise\":1"),
        edit("\"version\":41,", ""),
        edit("\"seed\":7", "\"seed\":7.5"),
        edit("\"control_period_s\":0.02", "\"control_period_s\":1e999"),
    ] {
        assert!(matches!(error, PolicyError::Metadata { .. }), "{error}");
    }
}

#[test]
fn features_of_onnx_that_reach_beyond_the_file() {
    // Appended fields merge into the message before them: here, into the model.
    let with = |suffix: &[u8]| {
        let mut bytes = bytes(&small()).to_vec();
        bytes.extend_from_slice(suffix);
        PolicyFile::parse(bytes.into()).unwrap_err()
    };
    // Field numbers above 15 have two-byte keys: 25 << 3 | 2 = 202.
    let functions = with(&[0xca, 0x01, 0x00]);
    assert!(matches!(functions, PolicyError::Forbidden { field: "functions", .. }));
    let training = with(&[0xa2, 0x01, 0x00]);
    assert!(matches!(training, PolicyError::Forbidden { field: "training_info", .. }));
    // A second graph (field 7) would merge into the first.
    let graph = with(&[0x3a, 0x00]);
    assert!(matches!(graph, PolicyError::TooMany { field: "graph", .. }));
    // One more property (field 14) of 2 GiB.
    let beyond = with(&[0x72, 0xff, 0xff, 0xff, 0xff, 0x07]);
    assert!(matches!(beyond, PolicyError::Wire { .. }), "{beyond}");

    // Inside the graph, and inside a tensor: external data at `../weights`, its location, a
    // sparse tensor, a quantisation note, a sub-graph.
    let nested = |payload: &[u8]| {
        let field = |number: u8, payload: &[u8]| {
            [&[number << 3 | 2, payload.len() as u8][..], payload].concat()
        };
        let graph = field(7, payload);
        PolicyFile::parse(graph.into()).unwrap_err()
    };
    for (payload, field) in [
        (&[0x2a, 2, 0x6a, 0][..], "external_data"),
        (&[0x2a, 2, 0x70, 1], "data_location"),
        (&[0x7a, 0], "sparse_initializer"),
        (&[0x72, 0], "quantization_annotation"),
        (&[0x0a, 4, 0x2a, 2, 0x32, 0], "g"),
        (&[0x0a, 4, 0x2a, 2, 0x2a, 0], "t"),
    ] {
        let error = nested(payload);
        assert!(
            matches!(error, PolicyError::Forbidden { field: f, .. } if f == field),
            "{field}: {error}"
        );
    }
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let bytes = bytes(&small());
    for end in 0..bytes.len() {
        assert!(PolicyFile::parse(bytes[..end].into()).is_err(), "cut after {end} bytes");
    }
}

#[test]
fn no_flipped_bit_does_harm() {
    let good = file(&small());
    let mut accepted = 0;
    for bit in 0..good.bytes().len() * 8 {
        let mut bad = good.bytes().to_vec();
        bad[bit / 8] ^= 1 << (bit % 8);
        if let Ok(file) = PolicyFile::parse(bad.into()) {
            // Weights, names and free text cannot be told from others; whatever passes is whole.
            file.spec().check().unwrap();
            file.metadata().check().unwrap();
            assert_eq!((file.spec().obs_dim(), file.spec().act_dim()), (97, 16));
            assert_ne!(file.sha256(), good.sha256());
            accepted += 1;
        }
    }
    assert!(accepted > 0 && accepted < good.bytes().len() * 8, "{accepted}");
}

proptest! {
    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..512)) {
        prop_assert!(PolicyFile::parse(bytes.into()).is_err());
    }

    #[test]
    fn a_file_with_many_random_bytes_never_panics(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20)
    ) {
        let mut bad = bytes(&small()).to_vec();
        for (index, value) in edits {
            let at = index.index(bad.len());
            bad[at] = value;
        }
        if let Ok(file) = PolicyFile::parse(bad.into()) {
            prop_assert!(file.spec().check().is_ok());
        }
    }
}
