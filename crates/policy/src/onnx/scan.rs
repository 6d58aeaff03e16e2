//! First pass over a policy file: every byte must belong to a field of a closed table.
//!
//! Walks the protobuf wire format without building anything. Refuses fields that are not in the
//! table, those that it names as forbidden, and more of a field than the table allows; the decoder
//! that comes after can therefore not be made to allocate much more than the file's own size.
//! The table is a tree, so its depth bounds the nesting.

use crate::PolicyError;

/// Longest name of anything in the graph, bytes.
const MAX_NAME: usize = 128;
/// Largest metadata value, bytes.
const MAX_METADATA_VALUE: usize = 256 << 10;
/// Largest tensor, bytes; the file's own limit is the sharper one.
const MAX_TENSOR: usize = crate::MAX_FILE_BYTES;

/// Protobuf wire types.
const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const LENGTH: u8 = 2;
const FIXED32: u8 = 5;

struct Table {
    message: &'static str,
    fields: &'static [Field],
}

struct Field {
    number: u32,
    name: &'static str,
    kind: Kind,
    /// At most this many in one message.
    count: u8,
}

enum Kind {
    Varint,
    /// Text or bytes of at most this length.
    Bytes(usize),
    Message(&'static Table),
    /// Known to ONNX, dangerous or needless in a policy.
    Forbidden,
}

const fn field(number: u32, name: &'static str, kind: Kind, count: u8) -> Field {
    Field { number, name, kind, count }
}

const fn forbidden(number: u32, name: &'static str) -> Field {
    field(number, name, Kind::Forbidden, 0)
}

static MODEL: Table = Table {
    message: "ModelProto",
    fields: &[
        field(1, "ir_version", Kind::Varint, 1),
        field(2, "producer_name", Kind::Bytes(MAX_NAME), 1),
        field(3, "producer_version", Kind::Bytes(MAX_NAME), 1),
        field(7, "graph", Kind::Message(&GRAPH), 1),
        field(8, "opset_import", Kind::Message(&OPERATOR_SET), 1),
        field(14, "metadata_props", Kind::Message(&PROPERTY), 32),
        forbidden(20, "training_info"),
        forbidden(25, "functions"),
        forbidden(26, "configuration"),
    ],
};

static OPERATOR_SET: Table = Table {
    message: "OperatorSetIdProto",
    fields: &[field(1, "domain", Kind::Bytes(MAX_NAME), 1), field(2, "version", Kind::Varint, 1)],
};

static PROPERTY: Table = Table {
    message: "StringStringEntryProto",
    fields: &[
        field(1, "key", Kind::Bytes(MAX_NAME), 1),
        field(2, "value", Kind::Bytes(MAX_METADATA_VALUE), 1),
    ],
};

static GRAPH: Table = Table {
    message: "GraphProto",
    fields: &[
        field(1, "node", Kind::Message(&NODE), 64),
        field(2, "name", Kind::Bytes(MAX_NAME), 1),
        field(5, "initializer", Kind::Message(&TENSOR), 64),
        field(11, "input", Kind::Message(&VALUE_INFO), 1),
        field(12, "output", Kind::Message(&VALUE_INFO), 1),
        forbidden(14, "quantization_annotation"),
        forbidden(15, "sparse_initializer"),
    ],
};

static NODE: Table = Table {
    message: "NodeProto",
    fields: &[
        field(1, "input", Kind::Bytes(MAX_NAME), 3),
        field(2, "output", Kind::Bytes(MAX_NAME), 1),
        field(3, "name", Kind::Bytes(MAX_NAME), 1),
        field(4, "op_type", Kind::Bytes(MAX_NAME), 1),
        field(5, "attribute", Kind::Message(&ATTRIBUTE), 1),
        field(7, "domain", Kind::Bytes(MAX_NAME), 1),
        forbidden(8, "overload"),
        forbidden(10, "device_configurations"),
    ],
};

static ATTRIBUTE: Table = Table {
    message: "AttributeProto",
    fields: &[
        field(1, "name", Kind::Bytes(MAX_NAME), 1),
        field(3, "i", Kind::Varint, 1),
        field(20, "type", Kind::Varint, 1),
        forbidden(5, "t"),
        forbidden(6, "g"),
        forbidden(10, "tensors"),
        forbidden(11, "graphs"),
        forbidden(21, "ref_attr_name"),
        forbidden(22, "sparse_tensor"),
        forbidden(23, "sparse_tensors"),
    ],
};

static TENSOR: Table = Table {
    message: "TensorProto",
    fields: &[
        field(1, "dims", Kind::Varint, 2),
        field(2, "data_type", Kind::Varint, 1),
        field(8, "name", Kind::Bytes(MAX_NAME), 1),
        field(9, "raw_data", Kind::Bytes(MAX_TENSOR), 1),
        forbidden(3, "segment"),
        forbidden(13, "external_data"),
        forbidden(14, "data_location"),
    ],
};

static VALUE_INFO: Table = Table {
    message: "ValueInfoProto",
    fields: &[
        field(1, "name", Kind::Bytes(MAX_NAME), 1),
        field(2, "type", Kind::Message(&TYPE), 1),
    ],
};

static TYPE: Table = Table {
    message: "TypeProto",
    fields: &[field(1, "tensor_type", Kind::Message(&TENSOR_TYPE), 1)],
};

static TENSOR_TYPE: Table = Table {
    message: "TypeProto.Tensor",
    fields: &[field(1, "elem_type", Kind::Varint, 1), field(2, "shape", Kind::Message(&SHAPE), 1)],
};

static SHAPE: Table =
    Table { message: "TensorShapeProto", fields: &[field(1, "dim", Kind::Message(&DIMENSION), 2)] };

static DIMENSION: Table = Table {
    message: "TensorShapeProto.Dimension",
    fields: &[
        field(1, "dim_value", Kind::Varint, 1),
        field(2, "dim_param", Kind::Bytes(MAX_NAME), 1),
    ],
};

/// Most fields of any table.
const MAX_FIELDS: usize = 10;

/// Checks the bytes of a whole model file against the table.
pub(crate) fn scan(bytes: &[u8]) -> Result<(), PolicyError> {
    message(bytes, 0, &MODEL)
}

/// Checks one message, which starts at byte `base` of the file.
fn message(bytes: &[u8], base: usize, table: &'static Table) -> Result<(), PolicyError> {
    let mut counts = [0_u8; MAX_FIELDS];
    let mut reader = Reader { bytes, at: 0, base };
    while reader.at < bytes.len() {
        let (number, wire) = reader.key()?;
        let Some(row) = table.fields.iter().position(|f| f.number == number) else {
            return Err(PolicyError::UnknownField { message: table.message, number });
        };
        let field = &table.fields[row];
        if matches!(field.kind, Kind::Forbidden) {
            return Err(PolicyError::Forbidden { message: table.message, field: field.name });
        }
        if counts[row] == field.count {
            return Err(PolicyError::TooMany {
                message: table.message,
                field: field.name,
                limit: field.count.into(),
            });
        }
        counts[row] += 1;
        value(&mut reader, wire, table, field)?;
    }
    Ok(())
}

fn value(
    reader: &mut Reader<'_>,
    wire: u8,
    table: &Table,
    field: &Field,
) -> Result<(), PolicyError> {
    match (&field.kind, wire) {
        (Kind::Varint, VARINT) => reader.varint().map(|_| ()),
        (Kind::Bytes(limit), LENGTH) => {
            let (start, length) = reader.block()?;
            if length <= *limit {
                return Ok(());
            }
            Err(PolicyError::Wire { offset: start, problem: "text or tensor above its size limit" })
        }
        (Kind::Message(inner), LENGTH) => {
            let (start, length) = reader.block()?;
            let end = reader.at;
            message(&reader.bytes[end - length..end], start, inner)
        }
        (_, VARINT | FIXED64 | LENGTH | FIXED32) => {
            Err(PolicyError::WireType { message: table.message, field: field.name })
        }
        _ => Err(reader.fail("unknown wire type")),
    }
}

/// Reads the protobuf wire format; never beyond its bytes.
struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    base: usize,
}

impl Reader<'_> {
    fn key(&mut self) -> Result<(u32, u8), PolicyError> {
        let key = self.varint()?;
        let number = u32::try_from(key >> 3).map_err(|_| self.fail("field number too large"))?;
        Ok((number, (key & 7) as u8))
    }

    fn varint(&mut self) -> Result<u64, PolicyError> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let Some(&byte) = self.bytes.get(self.at) else {
                return Err(self.fail("ends within a number"));
            };
            self.at += 1;
            // The tenth byte holds the one bit that is left.
            if shift == 63 && byte > 1 {
                return Err(self.fail("number above 64 bits"));
            }
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(self.fail("number above 64 bits"))
    }

    /// Passes over a length and as many bytes. Returns where in the file they start, and how many.
    fn block(&mut self) -> Result<(usize, usize), PolicyError> {
        let length = self.varint()?;
        let left = self.bytes.len() - self.at;
        let length = usize::try_from(length).ok().filter(|&n| n <= left);
        let length = length.ok_or_else(|| self.fail("announces more bytes than there are"))?;
        let start = self.base + self.at;
        self.at += length;
        Ok((start, length))
    }

    fn fail(&self, problem: &'static str) -> PolicyError {
        PolicyError::Wire { offset: self.base + self.at, problem }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tables() -> [&'static Table; 11] {
        [
            &MODEL,
            &OPERATOR_SET,
            &PROPERTY,
            &GRAPH,
            &NODE,
            &ATTRIBUTE,
            &TENSOR,
            &VALUE_INFO,
            &TYPE,
            &TENSOR_TYPE,
            &SHAPE,
        ]
    }

    #[test]
    fn every_table_fits_the_counters() {
        for table in tables() {
            assert!(table.fields.len() <= MAX_FIELDS, "{}", table.message);
        }
    }

    #[test]
    fn numbers_and_blocks_are_read_as_protobuf_writes_them() {
        // 300 = 0b10_0101100: low seven bits first, 0xac, then 0x02.
        let mut reader = Reader { bytes: &[0xac, 0x02, 0x02, 7, 8, 9], at: 0, base: 100 };
        assert_eq!(reader.varint().unwrap(), 300);
        assert_eq!(reader.block().unwrap(), (103, 2));
        assert_eq!(reader.at, 5);
    }

    #[test]
    fn lengths_beyond_the_end_are_refused() {
        // Field 7 (graph), length 2 GiB, two bytes there.
        let bytes = [0x3a, 0x80, 0x80, 0x80, 0x80, 0x08, 1, 2];
        let error = scan(&bytes).unwrap_err();
        assert!(matches!(error, PolicyError::Wire { offset: 6, .. }), "{error}");
        // Ten continuation bytes and one more.
        let error = scan(&[0xff; 11]).unwrap_err();
        assert!(matches!(error, PolicyError::Wire { .. }), "{error}");
    }

    #[test]
    fn forbidden_unknown_and_repeated_fields_have_their_own_errors() {
        // 25 << 3 | 2 = 202 = 0xca 0x01: functions.
        let functions = scan(&[0xca, 0x01, 0x00]).unwrap_err();
        assert!(matches!(functions, PolicyError::Forbidden { field: "functions", .. }));
        // 5 << 3 = 40: model_version, which a policy does not have.
        let unknown = scan(&[40, 1]).unwrap_err();
        assert!(matches!(unknown, PolicyError::UnknownField { number: 5, .. }));
        let twice = scan(&[8, 8, 8, 8]).unwrap_err();
        assert!(matches!(twice, PolicyError::TooMany { field: "ir_version", limit: 1, .. }));
        // ir_version as a length-delimited field; then a group, which is no wire type of proto3.
        let wire = scan(&[10, 0]).unwrap_err();
        assert!(matches!(wire, PolicyError::WireType { field: "ir_version", .. }));
        assert!(matches!(scan(&[11]).unwrap_err(), PolicyError::Wire { .. }));
    }
}
