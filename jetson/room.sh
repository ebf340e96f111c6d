# Sourced by the scripts that test packages and programs against a real server: serve_room WORK [ENCODE_FLAG...]
# makes a generated room in WORK, serves it from this machine, and sets `url` and `server` (the process).
# Programs: target/debug.
serve_room() {
    room_work=$1
    shift
    target/debug/slag-lab --quiet generate scene --out "$room_work/room" --n-views 12 >/dev/null
    target/debug/slag-encoder --quiet encode --scene "$room_work/room/scene.ply" --views "$room_work/room/transforms.json" --metric \
        --cell-gaussians 8192 --store "$room_work/store" "$@" >/dev/null
    target/debug/slag-encoder serve --store "$room_work/store" --listen 127.0.0.1:0 >"$room_work/log" &
    server=$!
    url=
    for _ in $(seq 20); do
        url=$(sed -n 's/.*\(http:[^ ]*\).*/\1/p' "$room_work/log" | head -n 1)
        [ -z "$url" ] || return 0
        sleep 0.5
    done
    cat "$room_work/log" >&2
    return 1
}
