// SPI, mode 0, the box is the slave: the same bytes as on the serial line.
//
// A clock of the line takes at least 6 of ours. The box's bit changes 3 to 4 of ours after the edge at which the master took
// the one before, so it is there in time for the next. Where there is nothing to say, zeros go out; zeros that come in
// end frames and mean nothing else, so that the master may clock out zeros to listen.
`default_nettype none
module spi (
    input  wire       clk,
    input  wire       rst,
    input  wire       sck,
    input  wire       mosi,
    output wire       miso,
    input  wire       ss_n,
    output reg  [7:0] rx_data,
    output reg        rx_valid,
    input  wire [7:0] tx_data,
    input  wire       tx_valid,
    output reg        tx_ready
);
  reg [2:0] clock;
  reg [1:0] data, select;
  always @(posedge clk) begin
    clock  <= {clock[1:0], sck};
    data   <= {data[0], mosi};
    select <= {select[0], !ss_n};
  end
  wire rise = clock[2:1] == 2'b01;

  reg [2:0] bits;
  reg [6:0] in;
  reg [7:0] out;
  reg loaded;  // `out` begins with a byte that is taken when its first bit is read: none is lost between two transfers
  assign miso = out[7];
  always @(posedge clk) begin
    rx_valid <= 0;
    tx_ready <= 0;
    if (rst || !select[1]) begin
      bits <= 0;
      out <= tx_valid ? tx_data : 8'd0;
      loaded <= tx_valid && !rst;
    end else if (rise) begin
      in   <= {in[5:0], data[1]};
      bits <= bits + 1'b1;
      out  <= {out[6:0], 1'b0};
      if (bits == 0) tx_ready <= loaded;
      if (bits == 7) begin  // a byte is over: take the next one
        rx_data  <= {in, data[1]};
        rx_valid <= 1;
        out      <= tx_valid ? tx_data : 8'd0;
        loaded   <= tx_valid;
      end
    end
  end
endmodule
`default_nettype wire
