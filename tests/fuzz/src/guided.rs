//! Inputs that libFuzzer makes, led by the branches that earlier ones reached: `make fuzz` builds this file with
//! `--cfg fuzzing` and LLVM's SanitizerCoverage.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_int};
use std::path::Path;

// The library that defines what is declared below.
use libfuzzer_sys as _;

/// A door, to be called with an input.
type Door<'a> = dyn FnMut(&[u8]) + 'a;

/// What SanitizerCoverage writes for each branch: where it is, and 1 where a function begins.
#[repr(C)]
struct Branch {
    address: usize,
    begins_function: usize,
}

unsafe extern "C" {
    fn LLVMFuzzerRunDriver(
        argc: *mut c_int,
        argv: *mut *mut *mut c_char,
        one: extern "C" fn(*const u8, usize) -> c_int,
    ) -> c_int;
    // The linker's names for the ends of both sections.
    static __start___sancov_cntrs: u8;
    static __stop___sancov_cntrs: u8;
    static __start___sancov_pcs: Branch;
    static __stop___sancov_pcs: Branch;
}

thread_local! {
    static DOOR: Cell<Option<*mut Door<'static>>> = const { Cell::new(None) };
}

extern "C" fn one(data: *const u8, size: usize) -> c_int {
    // SAFETY: libFuzzer hands over `size` bytes that stay until this returns; no bytes may come as null.
    let bytes = match size {
        0 => &[][..],
        _ => unsafe { std::slice::from_raw_parts(data, size) },
    };
    if let Some(door) = DOOR.get() {
        // SAFETY: `knock` put it there on this thread, lends it for as long as libFuzzer runs, and nothing else
        // uses it meanwhile.
        unsafe { (*door)(bytes) };
    }
    0
}

/// Lets libFuzzer knock with what lies in `corpora` and what it makes of it; what reaches something new goes into the
/// first of them. Ends the process.
pub fn knock(flags: &[String], corpora: &[&Path], mut door: impl FnMut(&[u8])) {
    let door: *mut Door<'_> = &mut door;
    // SAFETY: only the lifetime is forgotten; `door` outlives the call below, after which nothing is called.
    DOOR.set(Some(unsafe { std::mem::transmute::<*mut Door<'_>, *mut Door<'static>>(door) }));
    let mut told = vec!["fuzz".to_owned()];
    told.extend_from_slice(flags);
    told.extend(corpora.iter().map(|p| p.display().to_string()));
    let told: Vec<CString> = told.into_iter().map(|t| CString::new(t).unwrap()).collect();
    let mut told: Vec<*mut c_char> = told.iter().map(|t| t.as_ptr().cast_mut()).collect();
    let mut count = c_int::try_from(told.len()).unwrap();
    let mut told = told.as_mut_ptr();
    // SAFETY: `count` strings that end in nul and outlive the call.
    unsafe { LLVMFuzzerRunDriver(&mut count, &mut told, one) };
    DOOR.set(None);
}

/// Counter and place of each branch.
fn tables() -> (&'static [u8], &'static [Branch]) {
    // SAFETY: both sections are arrays that the compiler laid out, one element for each branch, in one order;
    // nothing writes them while this thread is here but this thread.
    let tables = unsafe {
        let (a, b) = (&raw const __start___sancov_cntrs, &raw const __stop___sancov_cntrs);
        let (c, d) = (&raw const __start___sancov_pcs, &raw const __stop___sancov_pcs);
        (
            std::slice::from_raw_parts(a, b.offset_from_unsigned(a)),
            std::slice::from_raw_parts(c, d.offset_from_unsigned(c)),
        )
    };
    assert_eq!(tables.0.len(), tables.1.len());
    tables
}

/// Marks the branches that this process has been in; whether one was not marked before. Counters begin again at 256.
pub fn mark(seen: &mut Vec<bool>) -> bool {
    let counters = tables().0;
    seen.resize(counters.len(), false);
    let mut any = false;
    for (seen, count) in seen.iter_mut().zip(counters) {
        any |= *count > 0 && !*seen;
        *seen |= *count > 0;
    }
    any
}

/// For each of our functions that this process has entered: the branches that it reached, and all of them, with those
/// that only a panic takes.
pub fn reached() -> BTreeMap<String, [usize; 2]> {
    let (counters, branches) = tables();
    let mut by_function = BTreeMap::new();
    let starts = (0..branches.len()).filter(|&i| branches[i].begins_function & 1 == 1);
    let starts: Vec<usize> = starts.chain([branches.len()]).collect();
    for pair in starts.windows(2) {
        let of = &counters[pair[0]..pair[1]];
        let reached = of.iter().filter(|c| **c > 0).count();
        if reached == 0 {
            continue;
        }
        // looked up is the byte before, as of an address to return to
        backtrace::resolve((branches[pair[0]].address + 1) as *mut _, |symbol| {
            let name = symbol.name().map(|n| format!("{n:#}")).unwrap_or_default();
            let own = name.trim_start_matches(['<', '&']);
            if own.starts_with("caudata") && !own.starts_with("caudata_fuzz") {
                let all: &mut [usize; 2] = by_function.entry(name).or_default();
                *all = [all[0].max(reached), all[1].max(of.len())];
            }
        });
    }
    by_function
}
