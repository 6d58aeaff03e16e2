//! The tensors of a chunk, written and read in place.
//!
//! They are ordinary `bytes` fields of the message and nearly all of a frame. Through the
//! generated types each would be copied once more on either side, which costs several times as
//! much as the rest of reading a frame; so they are split off first and joined on last.

use prost::DecodeError;
use prost::encoding::{
    DecodeContext, WireType, decode_key, decode_varint, encode_key, encode_varint,
    encoded_len_varint, key_len, skip_field,
};

use super::messages::{ROLLOUT_PROTOCOL, RolloutChunk};

/// Field of `Envelope` that holds the chunk.
const CHUNK: u32 = 3;
/// Fields of `RolloutChunk` that are tensors, from `observations` to `truncated`.
const FIRST: u32 = 12;
const COUNT: usize = 8;

/// The tensors' bytes, in the order of their fields.
pub(super) type Tensors<'a> = [&'a [u8]; COUNT];

/// The frame without the tensors of its chunk, and these. As everywhere in protobuf, the last of
/// several counts.
pub(super) fn split(frame: &[u8]) -> Result<(Vec<u8>, Tensors<'_>), DecodeError> {
    let mut tensors: Tensors<'_> = [&[]; COUNT];
    let mut rest = Vec::new();
    fields(frame, |tag, payload, whole| {
        let Some(chunk) = payload.filter(|_| tag == CHUNK) else {
            rest.extend_from_slice(whole);
            return Ok(());
        };
        let mut head = Vec::new();
        fields(chunk, |tag, payload, whole| {
            let slot = tag.checked_sub(FIRST).and_then(|i| tensors.get_mut(i as usize));
            match (slot, payload) {
                (Some(slot), Some(payload)) => *slot = payload,
                _ => head.extend_from_slice(whole),
            }
            Ok(())
        })?;
        encode_key(CHUNK, WireType::LengthDelimited, &mut rest);
        encode_varint(head.len() as u64, &mut rest);
        rest.extend_from_slice(&head);
        Ok(())
    })?;
    Ok((rest, tensors))
}

/// Calls `each` with number, payload (where it is text, bytes or a message) and all bytes of every
/// field of a message.
fn fields<'a>(
    mut message: &'a [u8],
    mut each: impl FnMut(u32, Option<&'a [u8]>, &'a [u8]) -> Result<(), DecodeError>,
) -> Result<(), DecodeError> {
    while !message.is_empty() {
        let field = message;
        let (tag, wire) = decode_key(&mut message)?;
        let value = message;
        // Checks that all of the value is there.
        skip_field(wire, tag, &mut message, DecodeContext::default())?;
        let mut payload = &value[..value.len() - message.len()];
        let is_block = wire == WireType::LengthDelimited;
        if is_block {
            decode_varint(&mut payload)?;
        }
        let whole = &field[..field.len() - message.len()];
        each(tag, is_block.then_some(payload), whole)?;
    }
    Ok(())
}

/// Appends numbers, little-endian. By blocks that stay in the cache: room that was filled with zeros first
/// would be written twice.
fn push_floats(frame: &mut Vec<u8>, values: &[f32]) {
    const BLOCK: usize = 1024;
    let mut block = [[0; 4]; BLOCK];
    for values in values.chunks(BLOCK) {
        let block = &mut block[..values.len()];
        for (out, value) in block.iter_mut().zip(values) {
            *out = value.to_le_bytes();
        }
        frame.extend_from_slice(block.as_flattened());
    }
}

/// The frame of a chunk whose other fields are `head`, with these observations.
pub(super) fn join(head: &[u8], chunk: &RolloutChunk, observations: &[f32]) -> Vec<u8> {
    let floats: [&[f32]; 6] = [
        observations,
        &chunk.actions,
        &chunk.action_means,
        &chunk.log_std,
        &chunk.log_probs,
        &chunk.rewards,
    ];
    let flags = [&chunk.terminated, &chunk.truncated];
    let lengths = floats.iter().map(|x| x.len() * 4).chain(flags.iter().map(|x| x.len()));
    let body: usize = (FIRST..)
        .zip(lengths)
        .map(|(tag, length)| key_len(tag) + encoded_len_varint(length as u64) + length)
        .sum();
    let body = head.len() + body;

    let mut frame = Vec::with_capacity(body + 16);
    encode_key(1, WireType::Varint, &mut frame);
    encode_varint(ROLLOUT_PROTOCOL.into(), &mut frame);
    encode_key(CHUNK, WireType::LengthDelimited, &mut frame);
    encode_varint(body as u64, &mut frame);
    frame.extend_from_slice(head);
    for (tag, values) in (FIRST..).zip(floats) {
        encode_key(tag, WireType::LengthDelimited, &mut frame);
        encode_varint(values.len() as u64 * 4, &mut frame);
        push_floats(&mut frame, values);
    }
    for (tag, values) in (FIRST + floats.len() as u32..).zip(flags) {
        encode_key(tag, WireType::LengthDelimited, &mut frame);
        encode_varint(values.len() as u64, &mut frame);
        frame.extend(values.iter().map(|&flag| u8::from(flag)));
    }
    frame
}
