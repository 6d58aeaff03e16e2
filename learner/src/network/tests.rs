//! The network's forward and backward passes against autograd, and what the seed and the bounds promise.

use super::*;
use tch::Kind;

fn spec(activation: Activation) -> NetworkSpec {
    NetworkSpec {
        obs_dim: 5,
        critic: SignedPermutation::identity(0),
        act_dim: 3,
        policy_hidden: vec![8, 7],
        value_hidden: vec![6],
        activation,
        init_std: 0.7,
        std_min: 0.05,
        std_max: 1.5,
        mirror: None,
    }
}

fn input(rows: i64) -> Tensor {
    // A fixed, irregular grid of numbers in ±2: no generator needed.
    let n = rows * 5;
    let values: Vec<f32> = (0..n).map(|i| ((i * 37 % 101) as f32 / 25.0) - 2.0).collect();
    Tensor::from_slice(&values).view([rows, 5])
}

/// The same function in autograd's terms.
fn reference(mlp: &Mlp, activation: Activation, x: &Tensor, leaves: &mut Vec<Tensor>) -> Tensor {
    let layers: Vec<_> = mlp.layers().collect();
    let mut h = x.shallow_clone();
    for (number, (weight, bias)) in layers.iter().enumerate() {
        let (weight, bias) =
            (weight.copy().set_requires_grad(true), bias.copy().set_requires_grad(true));
        h = h.linear(&weight, Some(&bias));
        if number + 1 < layers.len() {
            h = match activation {
                Activation::Elu => h.elu(),
                Activation::Swish => h.silu(),
                Activation::Tanh => h.tanh(),
                Activation::Relu => h.relu(),
            };
        }
        leaves.extend([weight, bias]);
    }
    h
}

fn close(a: &Tensor, b: &Tensor, tolerance: f64, what: &str) {
    let worst = (a - b).abs().max().double_value(&[]);
    assert!(worst <= tolerance, "{what}: off by {worst}");
}

#[test]
fn forward_and_backward_agree_with_autograd() {
    for activation in [Activation::Elu, Activation::Swish, Activation::Tanh, Activation::Relu] {
        let net = ActorCritic::new(spec(activation), 7, Device::Cpu);
        let gradient = net.zeros_like();
        let x = input(9);
        let (output, tape) = net.policy().forward_with_tape(&x);
        close(&output, &net.policy().forward(&x), 0.0, "with and without tape");

        let mut leaves = Vec::new();
        let expected = reference(net.policy(), activation, &x, &mut leaves);
        close(&output, &expected, 1e-6, "output");

        // Loss = ½ Σ y²: its gradient with respect to y is y.
        (expected.square().sum(Kind::Float) * 0.5).backward();
        net.policy().backward(&tape, output, gradient.policy());
        let own = gradient.policy().layers().flat_map(|(w, b)| [w, b]);
        for (number, (own, leaf)) in own.zip(&leaves).enumerate() {
            close(own, &leaf.grad(), 2e-6, &format!("{activation:?}, parameter {number}"));
        }
    }
}

#[test]
fn log_std_starts_where_told_stays_in_bounds_and_has_autograds_gradient() {
    let net = ActorCritic::new(spec(Activation::Elu), 7, Device::Cpu);
    close(&net.log_std(), &Tensor::from(0.7_f64.ln()), 1e-6, "start");

    let raw = net.raw_log_std.copy().set_requires_grad(true);
    let (lo, hi) = (0.05_f64.ln(), 1.5_f64.ln());
    (raw.sigmoid() * (hi - lo) + lo).sum(Kind::Float).backward();
    let (_, slope) = net.place().log_std_and_slope(&Vec::<f32>::try_from(raw.detach()).unwrap());
    close(&Tensor::from_slice(&slope), &raw.grad(), 1e-6, "slope");

    for raw in [-100.0, 100.0] {
        let _ = net.raw_log_std.shallow_clone().fill_(raw);
        let std = net.log_std().exp().double_value(&[0]);
        assert!((0.05 - 1e-6..=1.5 + 1e-6).contains(&std), "{std}");
    }
}

#[test]
fn the_seed_decides_the_weights_and_nothing_else_does() {
    tch::manual_seed(1);
    let a = ActorCritic::new(spec(Activation::Elu), 7, Device::Cpu).to_vec().unwrap();
    tch::manual_seed(2);
    let b = ActorCritic::new(spec(Activation::Elu), 7, Device::Cpu).to_vec().unwrap();
    let c = ActorCritic::new(spec(Activation::Elu), 8, Device::Cpu).to_vec().unwrap();
    assert_eq!(a, b);
    assert_ne!(a, c);
}

#[test]
fn zeros_do_not_see_changes() {
    let net = ActorCritic::new(spec(Activation::Tanh), 7, Device::Cpu);
    let zeros = net.zeros_like();
    net.copy_from_slice(&vec![0.5; net.layout().len()]).unwrap();
    assert_eq!(zeros.flat().double_value(&[0]), 0.0);
    assert!(net.copy_from_slice(&[1.0]).is_err());
}

#[test]
fn specs_that_cannot_work_are_refused() {
    let config = NetworkConfig { init_std: 2.0, ..NetworkConfig::default() };
    let error = NetworkSpec::new(&config, 4, 2).unwrap_err();
    assert!(error.to_string().contains("init_std <= std_max"), "{error}");
    let config = NetworkConfig { policy_hidden: vec![0], ..NetworkConfig::default() };
    assert!(NetworkSpec::new(&config, 4, 2).is_err());
    assert!(NetworkSpec::new(&NetworkConfig::default(), 4, 2).is_ok());
}

/// Exchanges the first two of five observations and negates the third; exchanges the outer two of three
/// actions and negates the middle one.
fn mirror() -> Mirror {
    Mirror {
        observation: SignedPermutation {
            source: vec![1, 0, 2, 3, 4],
            sign: vec![1.0, 1.0, -1.0, 1.0, 1.0],
        },
        action: SignedPermutation { source: vec![2, 1, 0], sign: vec![1.0, -1.0, 1.0] },
        feet: Vec::new(),
    }
}

fn symmetric() -> ActorCritic {
    let spec = spec(Activation::Elu).symmetric(mirror()).unwrap();
    ActorCritic::new(spec, 7, Device::Cpu)
}

/// The mirror images of rows.
fn image(rows: &Tensor, by: &SignedPermutation) -> Tensor {
    let source: Vec<i64> = by.source.iter().map(|&i| i as i64).collect();
    rows.index_select(1, &Tensor::from_slice(&source)) * Tensor::from_slice(&by.sign)
}

#[test]
fn a_symmetric_network_commutes_with_its_mirror() {
    let net = symmetric();
    let (x, mirror) = (input(9), mirror());
    let of_image = net.policy().forward(&image(&x, &mirror.observation)) * 100.0;
    let expected = image(&(net.policy().forward(&x) * 100.0), &mirror.action);
    close(&of_image, &expected, 1e-5, "policy");
    let value = net.value().forward(&image(&x, &mirror.observation));
    close(&value, &net.value().forward(&x), 1e-5, "value");
    let plain = ActorCritic::new(spec(Activation::Elu), 7, Device::Cpu);
    let value = plain.value().forward(&image(&x, &mirror.observation));
    let off = (value - plain.value().forward(&x)).abs().max();
    assert!(off.double_value(&[]) > 0.1, "a plain one does not");
    let other = NetworkSpec { obs_dim: 4, ..spec(Activation::Elu) };
    assert!(other.symmetric(mirror).is_err());
}

/// With free parameters θ and those of the network their symmetric part, the gradient with respect to θ is
/// what autograd says.
#[test]
fn the_gradient_of_a_symmetric_network_agrees_with_autograd() {
    let net = symmetric();
    let Some(symmetry) = &net.symmetry else { panic!("it has a mirror") };
    let gradient = net.zeros_like();
    let x = input(9);
    let (output, tape) = net.policy().forward_with_tape(&x);
    net.policy().backward(&tape, output, gradient.policy());
    let own = Tensor::from_slice(&symmetry.part_of(&gradient.to_vec().unwrap()));

    let free = net.flat().copy().set_requires_grad(true);
    let source: Vec<i64> = symmetry.0.source.iter().map(|&i| i as i64).collect();
    let image = free.index_select(0, &Tensor::from_slice(&source));
    let tied = (image * Tensor::from_slice(&symmetry.0.sign) + &free) * 0.5;
    let mut h = x;
    let layers = &net.indices.policy;
    for (number, &(weight, bias)) in layers.iter().enumerate() {
        let view = |index| net.layout.view(&tied, index);
        h = h.linear(&view(weight), Some(&view(bias)));
        if number + 1 < layers.len() {
            h = h.elu();
        }
    }
    (h.square().sum(Kind::Float) * 0.5).backward();
    let policy = net.policy_len() as i64;
    let expected = free.grad();
    close(&own.narrow(0, 0, policy), &expected.narrow(0, 0, policy), 2e-6, "gradient");
    assert!(expected.abs().max().double_value(&[]) > 1e-3);
}

#[test]
fn a_symmetric_network_stays_so_and_takes_no_other_parameters() {
    let net = symmetric();
    let Some(symmetry) = &net.symmetry else { panic!("it has a mirror") };
    let plain = ActorCritic::new(spec(Activation::Elu), 7, Device::Cpu);
    let error = net.copy_from_slice(&plain.to_vec().unwrap()).unwrap_err();
    assert!(error.to_string().contains("left and right"), "{error}");
    let mut adam = crate::adam::Adam::new(net.layout().len());
    let mut parameters = net.to_vec().unwrap();
    for step in 1..=20 {
        let noise = parameters.iter().map(|p| (p * step as f32).sin() + 0.1);
        let gradient = symmetry.part_of(&noise.collect::<Vec<f32>>());
        let rates = [(net.layout().len(), 1e-2)];
        adam.step(&mut parameters, (&gradient, 1.0), &rates);
    }
    net.copy_from_slice(&parameters).unwrap();
    let again = Tensor::from_slice(&symmetry.part_of(&parameters));
    close(&again, net.flat(), 1e-6, "after twenty steps");
}
