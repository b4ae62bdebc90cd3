//! Temporary.
use std::io::Write;
use uniground_geometry::scene::Instance;
use uniground_models::attributes::{self, Lexicon};
fn main() {
    let nouns = Lexicon::get().nouns();
    let out = std::path::PathBuf::from("/tmp/hub");
    let names: Vec<_> = nouns.iter().map(|n| n.name.clone()).collect();
    std::fs::write(out.join("nouns.json"), serde_json::to_vec(&names).unwrap()).unwrap();
    for room in std::env::args().skip(1) {
        let file = out.join(&room).join("instances.json");
        let instances: Vec<Instance> = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        let mut f = std::fs::File::create(out.join(&room).join("fit.f32")).unwrap();
        for i in &instances {
            let row: Vec<u8> = nouns.iter().flat_map(|n| attributes::noun_fit(n, i).to_le_bytes()).collect();
            f.write_all(&row).unwrap();
        }
    }
    let found = |name: &str| Lexicon::get().find(name).map(|n| n.name.clone());
    let all = std::io::read_to_string(std::io::stdin()).unwrap();
    for line in all.lines() {
        println!("{}\t{}", line, found(line).unwrap_or_default());
    }
}
