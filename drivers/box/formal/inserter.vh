// What the inserter promises, for any lines, targets, rates, holds and both modes. Part of inserter.v, to be proven by
// yosys-smtbmc with small numbers: nothing in the inserter depends on WIDTH, SEPARATION or RATE_BITS but by its sizes.
//
// A target is kept within -MOST … MOST, as box.v does. `count` counts what goes out as any controller does.
localparam signed [WIDTH-1:0] MOST = 5;
wire signed [WIDTH-1:0] beyond = whole_cycles ? 1 : 0;  // a cycle is begun for more than half a one
reg [4:0] begun = 0;
always @(posedge clk) begun <= begun + (begun != 31);
reg cycles_before, hold_before, both_before;
reg signed [WIDTH-1:0] inserted_before, count = 0, encoder = 0;
reg [1:0] phase_before;
wire [1:0] went = phase_out - phase_before;
wire signed [WIDTH-1:0] moved = went == 1 ? 1 : went == 3 ? -1 : 0;
wire is_inserted = inserted != inserted_before;
reg last_inserted = 0;
reg [NEAR_BITS-1:0] since = 0;  // clocks since the last edge that went out
reg watched = 0;                // `phase_before` and the counts hold
always @(posedge clk) begin
  cycles_before <= whole_cycles;
  hold_before <= hold;
  both_before <= raw_both;
  inserted_before <= inserted;
  phase_before <= phase_out;
  watched <= running && !rst;
  count <= watched ? count + moved : 0;
  encoder <= running && !rst ? encoder + (change == 1 ? 1 : change == 3 ? -1 : 0) : 0;
  since <= !watched ? CLEAR : went != 0 ? 1 : since + (since != CLEAR);
  if (!watched) last_inserted <= 0;
  else if (went != 0) last_inserted <= is_inserted;
end

// What makes these inductive: the pipeline knows the distance to the target of three clocks ago, and the cycle its goal.
reg signed [WIDTH-1:0] target_1, target_2, target_3;
reg signed [1:0] step_3;
reg [2:0] full = 0;  // clocks that the pipeline has run, up to 4
always @(posedge clk) begin
  {target_1, target_2, target_3} <= {target, target_1, target_2};
  step_3 <= step_before;
  full <= !running || rst ? 0 : full + (full != 4);
end
wire signed [WIDTH-1:0] was_1 = inserted - step, was_2 = was_1 - step_before, was_3 = was_2 - step_3;
wire signed [WIDTH-1:0] off_2 = target_2 - was_2, off_3 = target_3 - was_3;
wire signed [WIDTH-1:0] near_3 = off_3 > 6 ? 6 : off_3 < -6 ? -6 : off_3;
wire signed [WIDTH-1:0] base_1 = near_3 - step_before - step_3;
wire signed [WIDTH-1:0] goal = inserted + left;
always @* begin
  if (watched) begin
    a_phase: assert (phase_out == was + inserted[1:0]);
    a_step: assert (step != -2 && step_before != -2 && (full < 4 || step_3 != -2));
    a_moved: assert (full < 2 || inserted_before == was_1);
    a_goal: assert (whole_cycles ? goal[1:0] == 0 && goal <= MOST + 1 && goal >= -MOST - 1 : left == 0);
    a_left: assert (left <= 4 && left >= -4);
    a_range: assert (inserted <= MOST + beyond && inserted >= -MOST - beyond);
    a_idle: assert (full == 4 || (inserted == 0 && left == 0 && step == 0 && step_before == 0) || full > 1);
    if (full >= 2) a_off: assert (off == target_1 - was_1);
    if (full >= 3) a_near: assert (near_off == (off_2 > 6 ? 6 : off_2 < -6 ? -6 : off_2));
    if (full >= 4) begin
      a_over: assert (over == {base_1 > -1, base_1 > 1, base_1 > 0});
      a_under: assert (under == {base_1 < -1, base_1 < 1, base_1 < 0});
      a_far: assert (far_over == {base_1 > 1, base_1 > 3, base_1 > 2});
      a_deep: assert (far_under == {base_1 < -3, base_1 < -1, base_1 < -2});
    end
  end
end
always @* begin
  assume (rst == (begun < 2));
  assume (target >= -MOST && target <= MOST);
  assume (begun == 0 || whole_cycles == cycles_before);  // a board ties it
  if (watched) begin
    ledger: assert (count + moved == raw + inserted);
    one_line: assert (went != 2 || both_before);
    lossless: assert (raw == encoder);
    clear: assert (went == 0 || !(is_inserted || last_inserted) || since >= CLEAR);
    limit: assert (inserted <= MOST + beyond && inserted >= -MOST - beyond);
    held: assert (!hold_before || whole_cycles || !is_inserted);
  end
end
