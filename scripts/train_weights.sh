#!/usr/bin/env bash
# Train all shipped networks, in pieces, and put them into weights/:
#
#   SECONDS_LEFT=540 SCENES=/data/photos bash scripts/train_weights.sh trainer=gpu budget=paper
#
# Works for SECONDS_LEFT seconds (default: until all is done), saves and stops; called again it goes
# on where it stopped.  What follows are overrides of src.train; what stands below OUT (default
# out/weights) is kept.  NETWORKS names the experiments, in order.
set -uo pipefail
cd "$(dirname "$0")/.."
PY=${PY:-.venv/bin/python}
OUT=${OUT:-out/weights}
SCENES=${SCENES:-}
NETWORKS=${NETWORKS:-lf3x3 single256 $(cd conf/experiment && echo clean/*.yaml | sed 's/\.yaml//g') \
  mambatm setnet_small setnet_medium setnet_large}
end=$((SECONDS + ${SECONDS_LEFT:-10000000}))
scene=()
[ -n "$SCENES" ] && scene=("scene.root=$SCENES")

left() { echo $((end - SECONDS)); }

# within NAME COMMAND...: run it until the time is over; ends the script, all saved, if it is.
within() {
  local name=$1
  shift
  [ "$(left)" -gt 20 ] && timeout --signal=TERM --kill-after=60 "$(left)" "$@"
  local code=$?
  [ "$(left)" -le 20 ] && { echo "time is over at $name; call again to go on"; exit 0; }
  [ $code -eq 0 ] || { echo "$name failed with exit code $code" >&2; exit $code; }
}

for name in $NETWORKS; do
  folder=$OUT/$name
  trained() { ls "$folder"/part*/results.json 2>/dev/null | head -1 | xargs -r dirname; }
  if [ -z "$(trained)" ]; then
    part=$folder/part$(find "$folder" -maxdepth 1 -name 'part*' 2>/dev/null | wc -l)
    resume=()
    find "$folder" -name '*.ckpt' 2>/dev/null | grep -q . && resume=("ckpt=$folder")
    within "$name" $PY -m src.train "experiment=$name" "${scene[@]}" "${resume[@]}" "$@" \
      "hydra.run.dir=$part"
  fi
  ckpt=$(trained)/checkpoints/last.ckpt
  case $name in
    mambatm) method=(baseline=frames postprocess=mambatm "postprocess.restorer=$ckpt" optics=single) ;;
    single* | clean/*) method=("ckpt=$ckpt" optics=single) ;;
    *) method=("ckpt=$ckpt") ;;
  esac
  for set in test_photos test_targets; do
    root=()
    [ $set = test_photos ] && root=("${scene[@]}")
    [ -f "$folder/$set/results.json" ] || within "$name, $set" $PY -m src.eval \
      "${method[@]}" data=$set "${root[@]}" ${EVAL:-} "hydra.run.dir=$folder/$set"
  done
  $PY -m scripts.ship_weights "$(trained)" --name "$name" \
    --test "$folder/test_photos" "$folder/test_targets"
done
echo "all trained"
